"""Evaluation of detections: average precision, and errors of the true positives.

Detections are matched to objects frame by frame and are then true, false or dropped; see `detection_matching`.

*Precision* is the fraction of true ones among the detections above some score, *recall* the fraction of evaluated
objects that are matched to them. Each prefix of the ordered detections has a precision and a recall. *Average
precision* (AP) is the area under the curve of precision over recall, where precision is first replaced by the maximum
at this or any greater recall (all points, as in VOC 2010). Without evaluated objects it is NaN.

Two dialects differ in the order of the detections, and in AP by 10 to 20 points on the same boxes:

- `"global"`: all detections of the split by descending score, as in VOC, KITTI and nuScenes. The default.
- `"frame-order"`: frames in their given order, detections by descending score only within a frame, as in the released
  code of OpenCOOD and V2V4Real. The worst detection of the first frame then precedes the best of the second, and AP
  depends on the order of the frames. Only for comparison with numbers published that way.

*Range bins* [a, b) refer to the horizontal distance between agent and box centre. Objects and false detections belong
to the bin of their own distance, true detections to that of their object.
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
"""Those of V2V4Real and DAIR-V2X, and everything beyond [m]."""

_ERRORS_AT = 0.5
"""IoU threshold of the detections whose errors are evaluated."""


@dataclass(frozen=True, slots=True)
class ThresholdScore:
    """Scores at one IoU threshold; fractions in [0, 1], NaN where the denominator is 0.

    Attributes:
        ap: average precision by dialect.
        detections: number of true and false detections of any score.
        recall: fraction of objects matched to detections of at least the report's score threshold.
        precision: fraction of true ones among these detections.
    """

    ap: dict[str, float]
    detections: int
    recall: float
    precision: float


@dataclass(frozen=True, slots=True)
class GroupScore:
    """Number of evaluated objects, in total or of a range bin, and scores by IoU threshold."""

    truth: int
    at: dict[float, ThresholdScore]


@dataclass(frozen=True, slots=True)
class BoxErrors:
    """Median errors of the true detections at IoU 0.5 and the report's score threshold; NaN without any.

    Signed errors are detection minus truth. Lengths are in metres, angles in radians.

    Attributes:
        count: number of these detections.
        flipped: fraction with a heading error above 90 degrees.
        distance: horizontal distance of the centres.
        distance_90: its 90th percentile.
        longitudinal: signed, along the object's true heading; -0.2 is a box 0.2 m too far back.
        lateral: signed, to the object's left.
        radial: signed, along the line of sight from the agent; positive is too far away.
        vertical: signed, upwards.
        yaw: magnitude, modulo 180 degrees, as flips are counted separately.
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
    """Number of evaluated objects of one label, and their recall at IoU 0.5 and the report's score threshold."""

    truth: int
    recall: float


@dataclass(frozen=True, slots=True)
class DetectionReport:
    """Results of a split; `dataclasses.asdict` gives JSON values, except for NaN.

    Attributes:
        frames: number of frames.
        evaluation_range: x_min, x_max, y_min, y_max [m], None for unlimited.
        min_points: objects with fewer points were ignored.
        score_threshold: minimum score of the detections in recall, precision, errors and labels (not AP).
        ignored_truth: number of ignored objects.
        detections_outside: number of detections outside the range.
        overall: scores of all objects.
        by_range: scores by name of the range bin.
        errors: of the true detections.
        labels: recall by label, empty if the truth has none.
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
        """Average precision over all objects at one of the IoU thresholds, in [0, 1]."""
        return self.overall.at[threshold].ap[dialect]


def average_precision(true: BoolArray, truth_count: int) -> float:
    """Area under the precision-recall curve, all points.

    Args:
        true: (N,) whether each detection is true, in the order of the curve.
        truth_count: number of evaluated objects.

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
    """Evaluate detections over all frames together. Frames are iterated once and not kept.

    Args:
        frames: in the order of the "frame-order" dialect.
        thresholds: minimum IoU of true detections, in (0, 1].
        evaluation_range: boxes outside are ignored (truth) or discarded (detections); None for unlimited.
        min_points: objects with fewer points are ignored; 0 also evaluates objects without points.
        range_bins: [first, last) distances with scores of their own [m].
        score_threshold: minimum score of the detections in recall, precision, errors and labels; AP uses all.

    Raises:
        ValueError: no or invalid thresholds, a frame without point counts where `min_points` needs them, or an empty
            range.
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
    """The detections at one IoU threshold by frame, descending scores: (N,) arrays."""

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
    """Accumulator of the frames."""

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
    """Scores of objects and detections at distances in [first, last)."""
    truth = int(((first <= truth_distance) & (truth_distance < last)).sum())
    at = {}
    for threshold, curve in curves.items():
        distance = _joined(curve.distance)
        group = (first <= distance) & (distance < last)
        score, true = _joined(curve.score)[group], _joined(curve.true).astype(np.bool_)[group]
        confident = score >= score_threshold
        at[threshold] = ThresholdScore(
            ap={
                "global": average_precision(true[np.argsort(-score, kind="stable")], truth),
                "frame-order": average_precision(true, truth),
            },
            detections=len(true),
            recall=_share(int(true[confident].sum()), truth),
            precision=_share(int(true[confident].sum()), int(confident.sum())),
        )
    return GroupScore(truth, at)


def _box_errors(detections: Boxes, truth: Boxes) -> BoxErrors:
    """Errors of detections against their matched objects, row by row."""
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
    """(N,) horizontal distance of the centres from the origin [m]."""
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
