"""How well a detector finds objects: average precision, and what is wrong with the boxes it finds.

Which detections are true, false or dropped is decided frame by frame, as `detection_matching` says.

*Precision* is the share of true ones among the detections of at least some score, *recall* the share of counted objects
that they found. Going through the detections in some order gives a precision and a recall after each of them. *Average
precision* (AP) is the area under the curve of precision over recall, where precision is first replaced by the highest
one at this or any greater recall (all points, as in VOC 2010). Without any object to find it is NaN.

The order is where two dialects differ, and with it AP, by 10 to 20 points on the same boxes:

- `"global"`: all detections of the split by falling score. It is what VOC, KITTI and nuScenes mean by AP, and ours.
- `"frame-order"`: frame after frame as they come, by falling score only within a frame, which is what the released
  code of OpenCOOD and V2V4Real computes. A poor detection of the first frame then comes before the best of the second,
  and AP changes with the order of the frames. Only for comparison with numbers published that way.

*Range bins* [a, b) go by the distance between agent and box centre, seen from above. An object counts in the bin of its
own distance, a true detection in that of its object, and a false one in that of its own distance.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.evaluation.detection_matching import (
    DROPPED,
    DetectionFrame,
    EvaluationRange,
    Scene,
    match,
    prepare,
)
from cobevglue.typing import BoolArray, FloatArray, IntArray

__all__ = [
    "DIALECTS",
    "RANGE_BINS",
    "THRESHOLDS",
    "BoxErrors",
    "DetectionFrame",
    "DetectionReport",
    "GroupScore",
    "LabelRecall",
    "ThresholdScore",
    "average_precision",
    "evaluate_detections",
]

DIALECTS = ("global", "frame-order")
THRESHOLDS = (0.3, 0.5, 0.7)
RANGE_BINS = ((0.0, 30.0), (30.0, 50.0), (50.0, 100.0), (100.0, math.inf))
"""Those of V2V4Real and DAIR-V2X [m], and what is beyond."""

_ERRORS_AT = 0.5
"""IoU from which a detection's errors are looked at."""


@dataclass(frozen=True, slots=True)
class ThresholdScore:
    """Objects and detections at one IoU threshold; shares in [0, 1], NaN where there is nothing to divide by.

    Attributes:
        ap: average precision by dialect.
        detections: true and false ones, of any score.
        recall: share of objects found by detections of at least the report's score threshold.
        precision: share of true ones among these detections.
    """

    ap: dict[str, float]
    detections: int
    recall: float
    precision: float


@dataclass(frozen=True, slots=True)
class GroupScore:
    """All objects, or those of a range bin: how many count, and the scores by IoU threshold."""

    truth: int
    at: dict[float, ThresholdScore]


@dataclass(frozen=True, slots=True)
class BoxErrors:
    """Of the true detections at IoU 0.5 of at least the report's score threshold; medians, NaN without any.

    Signed errors are detection minus truth. Lengths are in metres, angles in radians.

    Attributes:
        count: how many there are.
        flipped: share whose heading is off by more than a quarter turn.
        distance: between the centres, seen from above.
        distance_90: the same, nine in ten are better.
        longitudinal: signed, along the object's true heading; -0.2 is a box that sits 0.2 m too far back.
        lateral: signed, to the object's left.
        radial: signed, along the line of sight from the agent; positive is too far away.
        vertical: signed, upwards.
        yaw: magnitude, modulo half a turn, as flips are counted apart.
        length, width, height: signed.
    """

    count: int
    flipped: float
    distance: float
    distance_90: float
    longitudinal: float
    lateral: float
    radial: float
    vertical: float
    yaw: float
    length: float
    width: float
    height: float


@dataclass(frozen=True, slots=True)
class LabelRecall:
    """How many objects of one label count, and the share found at IoU 0.5 and the report's score threshold."""

    truth: int
    recall: float


@dataclass(frozen=True, slots=True)
class DetectionReport:
    """Everything about a split; `dataclasses.asdict` is ready for JSON but for NaN.

    Attributes:
        frames: how many there were.
        evaluation_range: x_min, x_max, y_min, y_max [m], None for everywhere.
        min_points: objects with fewer points were ignored.
        score_threshold: least score of the detections behind recall, precision, errors and labels (not AP).
        ignored_truth: how many objects were ignored.
        detections_outside: how many detections lay outside the range.
        overall: all objects.
        by_range: objects by distance, by the name of the bin.
        errors: of the boxes found.
        labels: recall by label, empty where the truth has none.
    """

    frames: int
    evaluation_range: EvaluationRange | None
    min_points: int
    score_threshold: float
    ignored_truth: int
    detections_outside: int
    overall: GroupScore
    by_range: dict[str, GroupScore]
    errors: BoxErrors
    labels: dict[str, LabelRecall]

    def ap(self, threshold: float, dialect: str = "global") -> float:
        """Average precision of all objects at one of the IoU thresholds, in [0, 1]."""
        return self.overall.at[threshold].ap[dialect]


def average_precision(true: BoolArray, truth_count: int) -> float:
    """Area under the precision-recall curve, all points.

    Args:
        true: (N,) whether a detection is true, in the order that the curve goes through them.
        truth_count: how many objects there are to find.

    Returns:
        In [0, 1]; NaN if there are no objects.
    """
    if truth_count == 0:
        return math.nan
    precision = np.cumsum(true) / np.arange(1, len(true) + 1)
    envelope = np.maximum.accumulate(precision[::-1])[::-1]
    return float(envelope[true].sum()) / truth_count  # recall grows by one object at each true detection


def evaluate_detections(
    frames: Iterable[DetectionFrame],
    thresholds: Sequence[float] = THRESHOLDS,
    evaluation_range: EvaluationRange | None = None,
    min_points: int = 0,
    range_bins: Sequence[tuple[float, float]] = RANGE_BINS,
    score_threshold: float = 0.3,
) -> DetectionReport:
    """Compare detections with the truth, over all frames together. Frames are used once and not kept.

    Args:
        frames: in the order that the "frame-order" dialect goes through them.
        thresholds: IoU from which a detection is true, in (0, 1].
        evaluation_range: what lies outside is ignored (truth) or left out (detections); None for everywhere.
        min_points: objects with fewer points in them are ignored; 0 counts those that no point hit, too.
        range_bins: [first, last) distances that are reported apart [m].
        score_threshold: least score of the detections behind recall, precision, errors and labels; AP uses all.

    Raises:
        ValueError: no or bad thresholds, a frame without what is needed, or an empty range.
    """
    if not thresholds or not all(0.0 < t <= 1.0 for t in thresholds):
        raise ValueError(f"thresholds must be in (0, 1], got {tuple(thresholds)}")
    tally = _Tally({float(t): _Curve() for t in thresholds}, score_threshold)
    for frame in frames:
        tally.add(frame, prepare(frame, evaluation_range, min_points))
    distance = _joined(tally.truth_distance)
    return DetectionReport(
        frames=tally.frames,
        evaluation_range=evaluation_range,
        min_points=min_points,
        score_threshold=score_threshold,
        ignored_truth=tally.ignored,
        detections_outside=tally.outside,
        overall=_score(tally.curves, distance, 0.0, math.inf, score_threshold),
        by_range={_bin_name(a, b): _score(tally.curves, distance, a, b, score_threshold) for a, b in range_bins},
        errors=_box_errors(Boxes.concatenate(tally.true_detections), Boxes.concatenate(tally.found_truth)),
        labels={name: LabelRecall(n, tally.found_labels[name] / n) for name, n in sorted(tally.labels.items())},
    )


@dataclass(slots=True)
class _Curve:
    """What counts for AP at one IoU threshold, frame by frame, best detections first: (N,) each."""

    score: list[FloatArray] = field(default_factory=list)
    true: list[BoolArray] = field(default_factory=list)
    distance: list[FloatArray] = field(default_factory=list)

    def add(self, scene: Scene, found: IntArray) -> None:
        kept = found != DROPPED
        found = found[kept]
        own = _distance(scene.detections[kept])
        self.score.append(scene.score[kept])
        self.true.append(found >= 0)
        self.distance.append(np.where(found >= 0, np.append(_distance(scene.truth), 0.0)[found], own))


@dataclass(slots=True)
class _Tally:
    """What is kept of the frames."""

    curves: dict[float, _Curve]
    score_threshold: float
    frames: int = 0
    ignored: int = 0
    outside: int = 0
    truth_distance: list[FloatArray] = field(default_factory=list)
    true_detections: list[Boxes] = field(default_factory=list)
    found_truth: list[Boxes] = field(default_factory=list)
    labels: Counter[str] = field(default_factory=Counter)
    found_labels: Counter[str] = field(default_factory=Counter)

    def add(self, frame: DetectionFrame, scene: Scene) -> None:
        self.frames += 1
        self.ignored += int((~scene.counted).sum())
        self.outside += len(frame.detections) - len(scene.detections)
        self.truth_distance.append(_distance(scene.truth[scene.counted]))
        for threshold, curve in self.curves.items():
            curve.add(scene, match(scene, threshold))
        found = match(scene, _ERRORS_AT)
        true = (found >= 0) & (scene.score >= self.score_threshold)
        self.true_detections.append(scene.detections[true].replace(label=None, track_id=None))
        self.found_truth.append(scene.truth[found[true]].replace(label=None, track_id=None))
        if scene.truth.label is not None:
            self.labels.update(scene.truth.label[scene.counted].tolist())
            self.found_labels.update(scene.truth.label[found[true]].tolist())


def _score(
    curves: dict[float, _Curve], truth_distance: FloatArray, first: float, last: float, score_threshold: float
) -> GroupScore:
    """The scores of what is at distances in [first, last)."""
    truth = int(((first <= truth_distance) & (truth_distance < last)).sum())
    at = {}
    for threshold, curve in curves.items():
        distance = _joined(curve.distance)
        group = (first <= distance) & (distance < last)
        score, true = _joined(curve.score)[group], _joined(curve.true).astype(np.bool_)[group]
        sure = score >= score_threshold
        at[threshold] = ThresholdScore(
            ap={
                "global": average_precision(true[np.argsort(-score, kind="stable")], truth),
                "frame-order": average_precision(true, truth),
            },
            detections=len(true),
            recall=_share(int(true[sure].sum()), truth),
            precision=_share(int(true[sure].sum()), int(sure.sum())),
        )
    return GroupScore(truth, at)


def _box_errors(detections: Boxes, truth: Boxes) -> BoxErrors:
    """Errors of detections, row by row against the object that each of them found."""
    gap = detections.center - truth.center
    c, s = np.cos(truth.yaw), np.sin(truth.yaw)
    turn = np.abs(np.arctan2(np.sin(detections.yaw - truth.yaw), np.cos(detections.yaw - truth.yaw)))
    sight = truth.center[:, :2] / np.maximum(_distance(truth), 1e-9)[:, None]
    distance = np.hypot(gap[:, 0], gap[:, 1])
    length, width, height = (_median(column) for column in (detections.size - truth.size).T)
    return BoxErrors(
        count=len(truth),
        flipped=_share(int((turn > math.pi / 2).sum()), len(truth)),
        distance=_median(distance),
        distance_90=float(np.quantile(distance, 0.9)) if len(distance) else math.nan,
        longitudinal=_median(c * gap[:, 0] + s * gap[:, 1]),
        lateral=_median(c * gap[:, 1] - s * gap[:, 0]),
        radial=_median((sight * gap[:, :2]).sum(axis=1)),
        vertical=_median(gap[:, 2]),
        yaw=_median(np.minimum(turn, math.pi - turn)),
        length=length,
        width=width,
        height=height,
    )


def _distance(boxes: Boxes) -> FloatArray:
    """(N,) of the centres from the origin, seen from above [m]."""
    distance: FloatArray = np.hypot(boxes.center[:, 0], boxes.center[:, 1])
    return distance


def _bin_name(first: float, last: float) -> str:
    return f">= {first:g} m" if math.isinf(last) else f"{first:g}-{last:g} m"


def _joined(parts: Sequence[FloatArray | BoolArray]) -> FloatArray:
    return np.concatenate([np.zeros(0), *parts])


def _median(values: FloatArray) -> float:
    return float(np.median(values)) if len(values) else math.nan


def _share(part: int, whole: int) -> float:
    return part / whole if whole else math.nan
