"""Matching of detections and ground-truth objects: true positives, false positives, missed objects.

*Evaluated* (`counted`): an object whose centre is in the evaluation range (borders included) and that has at least
`min_points` points. All others are *ignored*: detecting them is neither required nor an error. With `min_points=0`
objects without points are evaluated, too. Detections whose centre is outside the range are discarded.

*Matching*, for each IoU threshold: in descending order of score (equal scores in order of their rows), each detection
is assigned to the evaluated object of largest bird's-eye-view IoU among those not yet matched. It is *true* if the IoU
is at least the threshold; otherwise the object stays unmatched. A detection that is not true but overlaps an ignored
object by the threshold or more is *dropped*; an ignored object can drop any number of them. All others are *false*. A
second detection of an evaluated object is therefore false.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.iou import bev_iou
from cobevglue.typing import BoolArray, FloatArray, IntArray

__all__ = [
    "DROPPED",
    "FALSE",
    "DetectionFrame",
    "EvaluationRange",
    "Failure",
    "Scene",
    "find_failures",
    "match",
    "prepare",
]

EvaluationRange = tuple[float, float, float, float]
"""x_min, x_max, y_min, y_max in the agent's LiDAR frame [m]."""

FALSE, DROPPED = -1, -2
"""In place of a row of the ground truth: a false positive, or a dropped detection."""


@dataclass(frozen=True, eq=False, slots=True)
class DetectionFrame:
    """The detections and ground truth of one agent in one frame, in the agent's LiDAR frame.

    Attributes:
        detections: N boxes with scores.
        truth: K boxes; results are also reported by label, where there are labels.
        point_count: (K,) number of points of the cloud in each object; None if unknown.
        name: of the frame, for lists of failures and error messages.
        agent: name of the agent, for the same.
        detection_point_count: (N,) number of points in each detection, or None.

    Raises:
        ValueError: detections without scores, or counts of wrong shape; the message names the frame.
    """

    detections: Boxes
    truth: Boxes
    point_count: IntArray | None = None
    name: str = ""
    agent: str = ""
    detection_point_count: IntArray | None = None

    def __post_init__(self) -> None:
        """Check scores and counts."""
        if self.detections.score is None and len(self.detections):
            raise ValueError(f"{self._where}detections: score: average precision needs scores, got None")
        for field, counts, boxes in (
            ("point_count", self.point_count, self.truth),
            ("detection_point_count", self.detection_point_count, self.detections),
        ):
            if counts is not None and np.shape(counts) != (len(boxes),):
                raise ValueError(f"{self._where}{field} must have shape ({len(boxes)},), got {np.shape(counts)}")

    @property
    def _where(self) -> str:
        return "".join(f"{part}: " for part in (self.name, self.agent) if part)


@dataclass(frozen=True, eq=False, slots=True)
class Scene:
    """A frame prepared for matching.

    Attributes:
        detections: N boxes inside the range, by descending score (stable).
        rows: (N,) their rows in the frame's detections.
        score: (N,) their scores.
        truth: K boxes.
        counted: (K,) whether each is evaluated.
        iou: (N, K) bird's-eye-view IoU.
    """

    detections: Boxes
    rows: IntArray
    score: FloatArray
    truth: Boxes
    counted: BoolArray
    iou: FloatArray


def prepare(frame: DetectionFrame, evaluation_range: EvaluationRange | None = None, min_points: int = 0) -> Scene:
    """Sort the detections, discard those outside the range, and determine the evaluated objects.

    Args:
        frame: the frame.
        evaluation_range: None for unlimited.
        min_points: objects with fewer points in them are ignored.

    Raises:
        ValueError: `min_points` is not 0 and the frame has no point counts, or the range is empty.
    """
    counted = inside(frame.truth, evaluation_range)
    if min_points > 0:
        if frame.point_count is None:
            raise ValueError(f"{frame.name}: min_points={min_points} needs frames with a point_count, got None")
        counted = counted & (np.asarray(frame.point_count) >= min_points)
    score = frame.detections.score if frame.detections.score is not None else np.zeros(0)
    order = np.argsort(-score, kind="stable")
    order = order[inside(frame.detections, evaluation_range)[order]]
    detections = frame.detections[order]
    return Scene(detections, order, score[order], frame.truth, counted, bev_iou(detections, frame.truth))


def inside(boxes: Boxes, evaluation_range: EvaluationRange | None) -> BoolArray:
    """(N,) whether the centre of each box is in the range, borders included."""
    if evaluation_range is None:
        return np.ones(len(boxes), dtype=np.bool_)
    x_min, x_max, y_min, y_max = evaluation_range
    if not (x_min < x_max and y_min < y_max):
        raise ValueError(f"evaluation_range must be x_min < x_max, y_min < y_max, got {evaluation_range}")
    x, y = boxes.center[:, 0], boxes.center[:, 1]
    within: BoolArray = (x_min <= x) & (x <= x_max) & (y_min <= y) & (y <= y_max)
    return within


def match(scene: Scene, threshold: float) -> IntArray:
    """Match detections to objects, as defined in the module docstring.

    Args:
        scene: N detections by descending score, and K objects.
        threshold: minimum IoU of a true detection.

    Returns:
        (N,) row of the matched object in [0, K), each at most once, or `FALSE` or `DROPPED`.
    """
    free = scene.counted.copy()
    on_ignored = (scene.iou[:, ~scene.counted] >= threshold).any(axis=1)
    found = np.where(on_ignored, DROPPED, FALSE).astype(np.int64)
    for row in np.flatnonzero((scene.iou[:, scene.counted] >= threshold).any(axis=1)):
        overlap = np.where(free, scene.iou[row], -1.0)
        best = int(overlap.argmax())
        if overlap[best] >= threshold:
            found[row] = best
            free[best] = False
    return found


@dataclass(frozen=True, slots=True)
class Failure:
    """A missed object or a false detection; lengths in metres, angles in radians.

    Attributes:
        kind: "missed" or "false".
        frame: name of the frame.
        agent: name of the agent.
        row: of the box in the frame's truth (missed) or detections (false).
        label: of a missed object, if it has one.
        x, y, z, length, width, height, yaw: the box, in the agent's LiDAR frame.
        distance: horizontal distance of its centre from the agent [m].
        points: number of points in the box; None if unknown.
        score: of a false detection; for a missed object, of the detection (of any score) with the largest IoU.
        best_iou: with that detection; for a false detection, the largest with any object: if it is large, the
            detection is a duplicate.
    """

    kind: str
    frame: str
    agent: str
    row: int
    label: str
    x: float
    y: float
    z: float
    length: float
    width: float
    height: float
    yaw: float
    distance: float
    points: int | None
    score: float | None
    best_iou: float


def find_failures(
    frame: DetectionFrame,
    threshold: float = 0.5,
    score_threshold: float = 0.3,
    evaluation_range: EvaluationRange | None = None,
    min_points: int = 0,
) -> Iterator[Failure]:
    """Missed objects of a frame, then its false detections, at a score threshold.

    Args:
        frame: the frame.
        threshold: minimum IoU of a true detection.
        score_threshold: minimum score of the detections.
        evaluation_range: as in `prepare`.
        min_points: as in `prepare`.
    """
    scene = prepare(frame, evaluation_range, min_points)
    found = np.where(scene.score >= score_threshold, match(scene, threshold), DROPPED)
    for row in np.flatnonzero(scene.counted & ~np.isin(np.arange(len(scene.truth)), found)):
        near = int(scene.iou[:, row].argmax()) if len(scene.detections) and scene.iou[:, row].any() else None
        score = None if near is None else float(scene.score[near])
        best = 0.0 if near is None else float(scene.iou[near, row])
        yield _failure("missed", frame, scene.truth, int(row), int(row), frame.point_count, score, best)
    for row in np.flatnonzero(found == FALSE):
        best = float(scene.iou[row].max(initial=0.0))
        original, counts, score = int(scene.rows[row]), frame.detection_point_count, float(scene.score[row])
        yield _failure("false", frame, scene.detections, int(row), original, counts, score, best)


def _failure(
    kind: str,
    frame: DetectionFrame,
    boxes: Boxes,
    row: int,
    original: int,
    counts: IntArray | None,
    score: float | None,
    best_iou: float,
) -> Failure:
    """A failure from row `row` of `boxes`; `original` is its row in the frame and in `counts`."""
    x, y, z = boxes.center[row].tolist()
    length, width, height = boxes.size[row].tolist()
    return Failure(
        kind=kind,
        frame=frame.name,
        agent=frame.agent,
        row=original,
        label="" if boxes.label is None or kind == "false" else str(boxes.label[row]),
        x=x,
        y=y,
        z=z,
        length=length,
        width=width,
        height=height,
        yaw=float(boxes.yaw[row]),
        distance=float(np.hypot(x, y)),
        points=None if counts is None else int(counts[original]),
        score=score,
        best_iou=best_iou,
    )
