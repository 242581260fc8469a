"""The figures of a report: curves over noise and bytes, and detections in one frame."""

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
from cobevglue.experiments.study import StudySettings, open_sequence, sequence_frames, sequence_names
from cobevglue.experiments.tables.bandwidth import bandwidth_points
from cobevglue.experiments.tables.noise import noise_curves
from cobevglue.experiments.tables.registration import registration_points
from cobevglue.experiments.tables.scope import Scope, aligner_title, as_is, method_title, needs
from cobevglue.se2 import SE2
from cobevglue.system import CoBEVGlue, StepOutput
from cobevglue.typing import FloatArray

__all__ = ["Picture", "bandwidth_pictures", "noise_pictures", "registration_pictures", "scene_pictures"]

Picture = tuple[str, bytes]
"""Caption and PNG file."""

_SHOWN = ("v2x-vit", "coalign", "cobevglue")
"""The methods of the paper's Figure 5."""
_NOISE = 3.0
"""The noise of that figure [m, degrees]."""
_FRAMES = 10
"""Number of frames of the sequence that are run; the last one is shown."""
_SCORE = 0.3
"""Detections with lower scores are not shown."""


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
    """Average precision over bytes for alignment."""
    from cobevglue.visualization.study_figures import ap_over_bytes

    title = "AP@0.5 over bytes sent for alignment"
    return [(title, ap_over_bytes(registration_points(scope, results, 0.5), title))]


def bandwidth_pictures(scope: Scope, results: Results) -> list[Picture]:
    """Average precision over all bytes, on a scale of base 2."""
    from cobevglue.visualization.study_figures import ap_over_bytes

    pictures = []
    for iou in (0.5, 0.7):
        title = f"AP@{iou:g} over bytes of a collaborator"
        pictures.append((title, ap_over_bytes(bandwidth_points(scope, results, iou), title, base=2)))
    return pictures


def scene_pictures(settings: StudySettings, models: Models, scope: Scope) -> list[Picture]:
    """One frame of the first sequence with a collaborator: the paper's Figures 5 and 6.

    They show detections under noise, clouds aligned by point registration, and objects matched by BEVGlue.
    """
    from cobevglue.visualization.study_figures import detections_picture, matching_picture

    sequence = _first_collaborative_sequence(settings, models)
    if sequence is None:
        return []
    ego, frame, truth = sequence.ego, sequence.frames[-1], sequence.truth[-1]
    counted = inside(truth.objects, models.evaluation_range) & (truth.point_count >= settings.min_points)
    objects = truth.objects[counted]
    ours = scope.ours
    pictures = []
    for name in _SHOWN:
        if name in scope.methods:
            out = _run(as_is(name, _NOISE), sequence, models, settings.seed)
            title = f"{method_title(name)}, noise {_NOISE:g} m, {_NOISE:g}°"
            caption = f"{title}: true boxes in green, detections of score {_SCORE:g} and more in red."
            clouds = _clouds(frame, ego, _true_poses(frame, ego))
            pictures.append((caption, detections_picture(clouds, objects, _confident(out.boxes), title)))
    for aligner in scope.registrations:
        if not needs(aligner, "pose"):
            condition = as_is(ours, 0.0, aligner, aligner_options={"budget_bytes": scope.budgets[-1]})
            out = _run(condition, sequence, models, settings.seed, last_only=True)
            title = f"{aligner_title(aligner)} on {scope.budgets[-1]:,} bytes of points"
            caption = f"{title}: all clouds aligned by its poses, true boxes in green. {_errors(frame, ego, out)}."
            clouds = _clouds(frame, ego, {name: one.ego_SE2_other for name, one in out.alignments.items()})
            pictures.append((caption, detections_picture(clouds, objects, Boxes.empty(), title)))
    out = _run(as_is(ours), sequence, models, settings.seed)
    for other, alignment in out.alignments.items():
        sent = out.alignment_bytes[other]
        caption = f"BEVGlue on {sent:,} bytes of boxes, matched ones joined. {_errors(frame, ego, out, other)}."
        pictures.append(
            (caption, matching_picture(frame.observations[ego].boxes, frame.observations[other].boxes, alignment))
        )
    return pictures


def _first_collaborative_sequence(settings: StudySettings, models: Models) -> ObservedSequence | None:
    """The first sequence with collaborators in the shown frame, observed up to this frame."""
    for number in range(len(sequence_names(settings))):
        sequence = ObservedSequence(models.detector)
        sequence.observe(islice(sequence_frames(settings, open_sequence(settings, number)), _FRAMES))
        if sequence.frames and sequence.frames[-1].collaborators(sequence.ego):
            return sequence
    return None


def _run(
    condition: Condition, sequence: ObservedSequence, models: Models, seed: int, last_only: bool = False
) -> StepOutput:
    """The output for the last frame; unless `last_only`, all frames before it are run, too."""
    system = CoBEVGlue(models.detector, models.fusion(condition), models.aligner(condition))
    disturbance = condition.make_disturbance()
    last = len(sequence.frames) - 1
    for index in range(last if last_only else 0, last + 1):
        frame = disturbance.apply(sequence.frames, index, sequence.ego, (seed, 0))
        out = system.collaborate(frame.observations, sequence.ego, frame.time, frame.claimed)
    return out


def _true_poses(frame: ObservedFrame, ego: str) -> dict[str, SE2]:
    """True poses of all collaborators in the ego's frame."""
    ego_SE3_world = inverse_SE3(frame.true[ego])
    return {other: SE2.from_matrix(ego_SE3_world @ frame.true[other]) for other in frame.collaborators(ego)}


def _clouds(frame: ObservedFrame, ego: str, poses: Mapping[str, SE2 | None]) -> list[FloatArray]:
    """The ego's points and those of the others, transformed by these poses; agents without a pose are left out."""
    clouds = [frame.observations[ego].points[:, :3].astype(np.float64)]
    for other, ego_SE2_other in poses.items():
        if ego_SE2_other is not None:
            clouds.append(ego_SE2_other.apply(frame.observations[other].points[:, :3]))
    return clouds


def _errors(frame: ObservedFrame, ego: str, out: StepOutput, only: str = "") -> str:
    """The pose errors as text."""
    parts = []
    for other, truth in _true_poses(frame, ego).items():
        if only in ("", other):
            pose = out.alignments[other].ego_SE2_other
            if pose is None:
                parts.append(f"{other}: refused, {out.alignments[other].reason}")
            else:
                shift, turn = pose.error_to(truth)
                parts.append(f"{other}: error {shift:.2f} m, {math.degrees(turn):.2f}°")
    return "; ".join(parts)


def _confident(boxes: Boxes) -> Boxes:
    return boxes if boxes.score is None else boxes[boxes.score >= _SCORE]
