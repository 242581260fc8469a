"""The figures of a report: curves over noise and bytes, and what methods saw in one frame."""

from __future__ import annotations

from itertools import islice

from cobevglue.alignment import Alignment
from cobevglue.boxes import Boxes
from cobevglue.datasets.poses import inverse_SE3
from cobevglue.disturbance import Moment
from cobevglue.evaluation.detection_matching import inside
from cobevglue.experiments.drive import Drive
from cobevglue.experiments.measure import Results
from cobevglue.experiments.models import Models
from cobevglue.experiments.study import StudySettings, drive_frames, drive_names, open_drive
from cobevglue.experiments.tables.noise import noise_curves
from cobevglue.experiments.tables.registration import registration_points
from cobevglue.experiments.tables.scope import Scope, as_is, method_title
from cobevglue.fusion import FUSION_METHODS
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


def scene_pictures(settings: StudySettings, models: Models) -> list[Picture]:
    """One frame of the first drive: what methods detect under noise, and what BEVGlue matches.

    Nothing where the ego has no company there.
    """
    from cobevglue.visualization.study_figures import detections_picture, matching_picture

    drive = Drive(models.detector)
    for number in range(len(drive_names(settings))):
        drive = Drive(models.detector)
        drive.see(islice(drive_frames(settings, open_drive(settings, number)), _FRAMES))
        if drive.moments and drive.moments[-1].collaborators(drive.ego):
            break
    else:
        return []
    ego, truth = drive.ego, drive.truth[-1].objects
    counts = inside(truth, models.evaluation_range) & (drive.truth[-1].point_count >= settings.min_points)
    pictures = []
    for name in _SHOWN:
        if name in FUSION_METHODS:
            moment, out = _run(name, drive, models, settings.seed)
            clouds = _clouds(moment, ego)
            title = f"{method_title(name)}, noise {_NOISE:g} m, {_NOISE:g}°"
            caption = f"{title}: true boxes in green, detections of score {_SCORE:g} and more in red."
            pictures.append((caption, detections_picture(clouds, truth[counts], _sure(out.boxes), title)))
    moment, out = _run("cobevglue", drive, models, settings.seed)
    for other, alignment in out.alignments.items():
        caption = f"What BEVGlue matches of {ego} and {other}: {_matched(alignment)}."
        pictures.append((caption, matching_picture(moment.seen[ego].boxes, moment.seen[other].boxes, alignment)))
    return pictures


def _run(name: str, drive: Drive, models: Models, seed: int) -> tuple[Moment, StepOutput]:
    """The last frame under noise; who remembers has seen those before."""
    condition = as_is(name, _NOISE)
    system = CoBEVGlue(models.detector, models.method(name), condition.make_aligner())
    noise = condition.make_disturbance()
    moments = [noise.apply(drive.moments, index, drive.ego, (seed, 0)) for index in range(len(drive.moments))]
    outs = [system.collaborate(moment.seen, drive.ego, moment.time, moment.claimed) for moment in moments]
    return moments[-1], outs[-1]


def _clouds(moment: Moment, ego: str) -> list[FloatArray]:
    """Everyone's points in the ego's frame, by the true poses."""
    clouds = []
    for agent, view in moment.seen.items():
        ego_SE2_agent = SE2.from_matrix(inverse_SE3(moment.true[ego]) @ moment.true[agent])
        clouds.append(ego_SE2_agent.apply(view.points[:, :3]))
    return clouds


def _sure(boxes: Boxes) -> Boxes:
    return boxes if boxes.score is None else boxes[boxes.score >= _SCORE]


def _matched(alignment: Alignment) -> str:
    return f"{len(alignment.matches)} objects" if alignment.accepted else f"refused, {alignment.reason}"
