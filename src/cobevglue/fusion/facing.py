"""Which way fused boxes face: as the agents that track the vehicles say."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.iou import bev_iou

__all__ = ["face_as_told"]

_SAME_OBJECT = 0.3
"""Overlap from which on a told box is of the same vehicle."""


def face_as_told(boxes: Boxes, told: Iterable[Boxes]) -> Boxes:
    """Boxes, each turned by 180 degrees where those that agents told of the same vehicle say so.

    Told boxes vote by their score and by how much they overlap. A network that decodes fused maps looks once at one
    moment; agents have looked twice, and at every moment before (`Perception`).

    Args:
        boxes: N boxes.
        told: each agent's boxes, in the same frame.
    """
    vote = np.zeros(len(boxes))
    for one in told:
        overlap = bev_iou(boxes, one)
        weight = np.where(overlap >= _SAME_OBJECT, overlap, 0.0) * (1.0 if one.score is None else one.score)
        vote += (weight * np.sign(np.cos(boxes.yaw[:, None] - one.yaw))).sum(axis=1)
    return boxes.turned_round(vote < 0.0)
