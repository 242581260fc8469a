"""Merges boxes of the same objects from several sources, such as the agents' detections and the fused features."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.iou import bev_iou, nms
from cobevglue.typing import FloatArray, IntArray

__all__ = ["merge_boxes"]

_RELIABILITY = 0.9
_LEAST_WEIGHT = 1e-12


def merge_boxes(
    sources: Sequence[Boxes], reliability: Sequence[float] | None = None, min_iou: float = 0.5, nms_iou: float = 0.15
) -> Boxes:
    """Weighted fusion of the boxes of several sources, after Solovyev et al., "Weighted boxes fusion" (2021).

    The best-scored box and, of each other source, the box that overlaps it most are one object; then the next best of
    the boxes that are left. The centre, size and axis of an object are averages weighted by the squared score, its
    direction is the one with the larger sum of weights, and its score is 1 - prod(1 - r s) over the sources, with their
    reliabilities r: sources that agree raise it, as if they were independent.

    Args:
        sources: S lists of boxes with scores, in one frame and of one instant. Boxes of one list are different objects.
        reliability: (S,) in [0, 1), of each source; 0.9 by default.
        min_iou: least bird's-eye-view IoU of two boxes of one object.
        nms_iou: overlap up to which two objects may both stay.

    Returns:
        The objects, best first, each with the label of its best-scored box if all sources have labels, without track
        ids.

    Raises:
        ValueError: a source has no scores (names it), or the reliabilities are not S numbers in [0, 1).
    """
    for number, boxes in enumerate(sources):
        if boxes.score is None:
            raise ValueError(f"sources: boxes of source {number} have no score")
    reliabilities = np.full(len(sources), _RELIABILITY) if reliability is None else np.asarray(reliability, np.float64)
    if reliabilities.shape != (len(sources),) or not ((reliabilities >= 0.0) & (reliabilities < 1.0)).all():
        raise ValueError(f"reliability must be {len(sources)} numbers in [0, 1), got {reliability}")
    labelled = all(one.label is not None for one in sources)
    boxes = Boxes.concatenate([one.replace(track_id=None, label=one.label if labelled else None) for one in sources])
    if not len(boxes):
        return boxes
    assert boxes.score is not None
    source = np.repeat(np.arange(len(sources)), [len(one) for one in sources])
    cluster = _clusters(boxes, source, min_iou)
    merged = _averages(boxes, cluster, reliabilities[source])
    if boxes.label is not None:
        best_first = np.argsort(-boxes.score, kind="stable")
        merged = merged.replace(label=boxes.label[best_first[np.unique(cluster[best_first], return_index=True)[1]]])
    return merged[nms(merged, nms_iou)]


def _clusters(boxes: Boxes, source: IntArray, min_iou: float) -> IntArray:
    """(N,) number of the object of each box."""
    assert boxes.score is not None
    overlap = bev_iou(boxes, boxes)
    cluster = np.full(len(boxes), -1)
    for number, best in enumerate(np.argsort(-boxes.score, kind="stable")):
        if cluster[best] >= 0:
            continue
        cluster[best] = number
        free = (cluster < 0) & (overlap[best] >= min_iou)
        for other in np.unique(source[free & (source != source[best])]):
            rows = np.flatnonzero(free & (source == other))
            cluster[rows[overlap[best, rows].argmax()]] = number
    return np.unique(cluster, return_inverse=True)[1]


def _averages(boxes: Boxes, cluster: IntArray, reliability: FloatArray) -> Boxes:
    """One box for each object, of the (N,) clusters."""
    assert boxes.score is not None
    weight = np.maximum(boxes.score**2, _LEAST_WEIGHT)

    def total(values: FloatArray) -> FloatArray:
        return np.stack([np.bincount(cluster, column) for column in values.T], axis=1)

    columns = np.column_stack(
        [np.ones(len(boxes)), boxes.center, boxes.size, np.cos(2 * boxes.yaw), np.sin(2 * boxes.yaw)]
    )
    sums = total(weight[:, None] * columns)
    mean = sums[:, 1:7] / sums[:, :1]
    axis = 0.5 * np.arctan2(sums[:, 8], sums[:, 7])
    vote = np.bincount(cluster, weight * np.cos(boxes.yaw - axis[cluster]))
    score = 1.0 - np.exp(np.bincount(cluster, np.log1p(-reliability * boxes.score)))
    return Boxes(mean[:, :3], mean[:, 3:], np.where(vote < 0.0, axis + np.pi, axis), score)
