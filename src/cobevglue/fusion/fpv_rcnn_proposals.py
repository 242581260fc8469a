"""FPV-RCNN's proposals: merging those of all agents, and boxes encoded relative to them."""

from __future__ import annotations

import math

import numpy as np

from cobevglue.boxes import Boxes, local_coordinates
from cobevglue.iou import bev_iou
from cobevglue.se2 import wrap_angle
from cobevglue.typing import FloatArray, IntArray

__all__ = ["decode_refinement", "encode_refinement", "merge_proposals"]

_LARGEST = 1.0
"""Limit of the logarithmic refinement of a size: the second stage makes no box more than e times larger."""


def merge_proposals(boxes: Boxes, min_iou: float) -> tuple[Boxes, IntArray]:
    """One proposal for each cluster of those that overlap (the paper's bounding box proposal matching).

    The best-scored proposal that is left takes all that overlap it, and so on; equal scores go by row order. Centre,
    size and heading are means of the members, weighted by their scores. Headings are compared modulo pi, as an agent
    may have confused front and back; the direction of the merged box is decided by a vote. Its score is the best.

    Args:
        boxes: N boxes with scores, of all agents, in one frame.
        min_iou: minimum rotated IoU of two proposals of one object.

    Returns:
        The K merged boxes, best first, and (K,) the number of proposals merged into each.

    Raises:
        ValueError: the boxes have no scores.
    """
    if boxes.score is None:
        raise ValueError("score: merge_proposals needs boxes with scores, got None")
    overlap = bev_iou(boxes, boxes) >= min_iou
    left = np.ones(len(boxes), dtype=bool)
    merged, counts = [], []
    for best in np.argsort(-boxes.score, kind="stable"):
        if left[best]:
            members = left & overlap[best]
            members[best] = True
            left &= ~members
            merged.append(_mean(boxes[members], boxes.yaw[best]))
            counts.append(np.count_nonzero(members))
    return Boxes.concatenate([Boxes.empty().replace(score=[]), *merged]), np.array(counts, dtype=np.int64)


def _mean(members: Boxes, yaw: float) -> Boxes:
    """The one box that these are; `yaw` is the best one's [rad]."""
    assert members.score is not None
    weight = np.maximum(members.score, 1e-9)
    turn = members.yaw - yaw
    facing = float((weight * np.cos(turn)).sum())
    turn -= math.pi * np.round(turn / math.pi)
    heading = wrap_angle(yaw + np.average(turn, weights=weight) + (math.pi if facing < 0.0 else 0.0))
    center, size = (np.average(values, axis=0, weights=weight) for values in (members.center, members.size))
    return Boxes([center], [size], [heading], [members.score.max()])


def encode_refinement(boxes: Boxes, proposals: Boxes) -> FloatArray:
    """(K, 7) refinements from each of K proposals to the box of the same row.

    As the residuals of an anchor, but in the proposal's own axes: offsets along and across its heading by its diagonal
    and upwards by its height, logarithms of the ratios of the sizes, and the rotation modulo pi: front and back are the
    proposal's.
    """
    offset = local_coordinates(boxes.center, proposals.center, proposals.yaw)
    diagonal = np.hypot(proposals.size[:, 0], proposals.size[:, 1])[:, None]
    turn = boxes.yaw - proposals.yaw
    return np.column_stack(
        [
            offset[:, :2] / diagonal,
            offset[:, 2] / proposals.size[:, 2],
            np.log(boxes.size / proposals.size),
            turn - math.pi * np.round(turn / math.pi),
        ]
    )


def decode_refinement(refinement: FloatArray, proposals: Boxes) -> Boxes:
    """The boxes of refinements (K, 7) of K proposals; scores are the proposals'."""
    diagonal = np.hypot(proposals.size[:, 0], proposals.size[:, 1])
    along, across = refinement[:, 0] * diagonal, refinement[:, 1] * diagonal
    c, s = np.cos(proposals.yaw), np.sin(proposals.yaw)
    shift = np.column_stack([c * along - s * across, s * along + c * across, refinement[:, 2] * proposals.size[:, 2]])
    return proposals.replace(
        center=proposals.center + shift,
        size=proposals.size * np.exp(np.clip(refinement[:, 3:6], -_LARGEST, _LARGEST)),
        yaw=wrap_angle(proposals.yaw + refinement[:, 6]),
    )
