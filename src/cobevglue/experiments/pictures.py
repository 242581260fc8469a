"""The figures of a report: curves over noise and bytes, and what methods saw in one frame."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import islice

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.datasets.poses import inverse_SE3
from cobevglue.disturbance import ObservedFrame
from cobevglue.evaluation.detection_matching import inside
from cobevglue.experiments.condition import Condition
from cobevglue.experiments.measure import Results
from cobevglue.experiments.models import Models
from cobevglue.experiments.observed_sequence import ObservedSequence
from cobevglue.experiments.study import StudySettings, drive_frames, drive_names, open_drive
from cobevglue.experiments.tables.noise import noise_curves
from cobevglue.experiments.tables.registration import registration_points
from cobevglue.experiments.tables.scope import Scope, aligner_title, as_is, method_title, needs
from cobevglue.se2 import SE2
from cobevglue.system import CoBEVGlue, StepOutput
from cobevglue.typing import FloatArray

__all__ = ["Picture", "noise_pictures", "registration_pictures", "scene_pictures"]

Picture = tuple[str, bytes]
"""Caption and PNG file."""

_SHOWN = ("v2x-vit", "coalign", "cobevglue")
"""The methods of the paper's Figure 5."""
_NOISE = 3.0
"""The noise of that figure [m, degrees]."""
_FRAMES = 10
"""So many frames of the drive are gone through; the last one is shown."""
_SCORE = 0.3
"""Detections that score less are not shown."""


def noise_pictures(scope: Scope, results: Results) -> list[Picture]:
    """Average precision over noise."""
    from cobevglue.visualization.study_figures import ap_over_noise

    pictures = []
    for iou in (0.5, 0.7):
        levels, curves = noise_curves(scope, results, iou)
        title = f"AP@{iou:g} under localisation noise"
        pictures.append((title, ap_over_noise(levels, curves, title)))
    return pictures


def registration_pictures(scope: Scope, results: Results) -> list[Picture]:
    """Average precision over communication."""
    from cobevglue.visualization.study_figures import ap_over_bytes

    title = "AP@0.5 over what is sent for alignment"
    return [(title, ap_over_bytes(registration_points(scope, results, 0.5), title))]


def scene_pictures(settings: StudySettings, models: Models, scope: Scope) -> list[Picture]:
    """One frame of the first drive in which the ego has company: the paper's Figures 5 and 6.

    What methods detect under noise; and where registration of points and BEVGlue put what collaborators saw.
    """
    from cobevglue.visualization.study_figures import detections_picture, matching_picture

    drive = _drive_in_company(settings, models)
    if drive is None:
        return []
    ego, frame, truth = drive.ego, drive.frames[-1], drive.truth[-1]
    counted = inside(truth.objects, models.evaluation_range) & (truth.point_count >= settings.min_points)
    objects = truth.objects[counted]
    (ours,) = scope.localised
    pictures = []
    for name in _SHOWN:
        if name in scope.methods:
            out = _run(as_is(name, _NOISE), drive, models, settings.seed)
            title = f"{method_title(name)}, noise {_NOISE:g} m, {_NOISE:g}°"
            caption = f"{title}: true boxes in green, detections of score {_SCORE:g} and more in red."
            clouds = _clouds(frame, ego, _true_poses(frame, ego))
            pictures.append((caption, detections_picture(clouds, objects, _sure(out.boxes), title)))
    for aligner in scope.registrations:
        if not needs(aligner, "pose"):
            condition = as_is(ours, 0.0, aligner, aligner_options={"budget_bytes": scope.budgets[-1]})
            out = _run(condition, drive, models, settings.seed, last_only=True)
            title = f"{aligner_title(aligner)} on {scope.budgets[-1]:,} bytes of points"
            caption = f"{title}: all clouds where it puts them, true boxes in green. {_errors(frame, ego, out)}."
            clouds = _clouds(frame, ego, {name: one.ego_SE2_other for name, one in out.alignments.items()})
            pictures.append((caption, detections_picture(clouds, objects, Boxes.empty(), title)))
    out = _run(as_is(ours), drive, models, settings.seed)
    for other, alignment in out.alignments.items():
        sent = out.alignment_bytes[other]
        caption = f"BEVGlue on {sent:,} bytes of boxes, those that match joined. {_errors(frame, ego, out, other)}."
        pictures.append(
            (caption, matching_picture(frame.observations[ego].boxes, frame.observations[other].boxes, alignment))
        )
    return pictures


def _drive_in_company(settings: StudySettings, models: Models) -> ObservedSequence | None:
    """The first drive at whose last shown frame there are others, gone through up to there."""
    for number in range(len(drive_names(settings))):
        drive = ObservedSequence(models.detector)
        drive.observe(islice(drive_frames(settings, open_drive(settings, number)), _FRAMES))
        if drive.frames and drive.frames[-1].collaborators(drive.ego):
            return drive
    return None


def _run(
    condition: Condition, drive: ObservedSequence, models: Models, seed: int, last_only: bool = False
) -> StepOutput:
    """What the ego concludes in the last frame; who remembers has seen those before."""
    system = CoBEVGlue(models.detector, models.method(condition.fusion), models.aligner(condition))
    disturbance = condition.make_disturbance()
    last = len(drive.frames) - 1
    for index in range(last if last_only else 0, last + 1):
        frame = disturbance.apply(drive.frames, index, drive.ego, (seed, 0))
        out = system.collaborate(frame.observations, drive.ego, frame.time, frame.claimed)
    return out


def _true_poses(frame: ObservedFrame, ego: str) -> dict[str, SE2]:
    """Of all collaborators in the ego's frame."""
    ego_SE3_world = inverse_SE3(frame.true[ego])
    return {other: SE2.from_matrix(ego_SE3_world @ frame.true[other]) for other in frame.collaborators(ego)}


def _clouds(frame: ObservedFrame, ego: str, poses: Mapping[str, SE2 | None]) -> list[FloatArray]:
    """The ego's points, and those of the others by these poses; without a pose they are left out."""
    clouds = [frame.observations[ego].points[:, :3].astype(np.float64)]
    for other, ego_SE2_other in poses.items():
        if ego_SE2_other is not None:
            clouds.append(ego_SE2_other.apply(frame.observations[other].points[:, :3]))
    return clouds


def _errors(frame: ObservedFrame, ego: str, out: StepOutput, only: str = "") -> str:
    """How far off the poses are."""
    parts = []
    for other, truth in _true_poses(frame, ego).items():
        if only in ("", other):
            pose = out.alignments[other].ego_SE2_other
            if pose is None:
                parts.append(f"{other}: refused, {out.alignments[other].reason}")
            else:
                shift, turn = pose.error_to(truth)
                parts.append(f"{other}: off by {shift:.2f} m, {math.degrees(turn):.2f}°")
    return "; ".join(parts)


def _sure(boxes: Boxes) -> Boxes:
    return boxes if boxes.score is None else boxes[boxes.score >= _SCORE]
