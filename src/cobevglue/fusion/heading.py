"""Headings of fused boxes: front or back is decided by the boxes that the agents transmitted."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.iou import bev_iou

__all__ = ["vote_headings"]

_SAME_OBJECT = 0.3
"""Minimum overlap at which a transmitted box is of the same vehicle."""


def vote_headings(boxes: Boxes, transmitted: Iterable[Boxes]) -> Boxes:
    """Boxes, each rotated by 180 degrees where the transmitted boxes of the same vehicle have the opposite heading.

    Votes are weighted by score and overlap. Transmitted boxes come from heading refinement and tracking
    (`Perception`), which fused features do not have.

    Args:
        boxes: N fused boxes in the ego frame.
        transmitted: each agent's boxes, in the same frame.
    """
    vote = np.zeros(len(boxes))
    for one in transmitted:
        overlap = bev_iou(boxes, one)
        weight = np.where(overlap >= _SAME_OBJECT, overlap, 0.0) * (1.0 if one.score is None else one.score)
        vote += (weight * np.sign(np.cos(boxes.yaw[:, None] - one.yaw))).sum(axis=1)
    return boxes.flip_headings(vote < 0.0)
