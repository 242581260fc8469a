"""Keypoints of a proposal in FPV-RCNN: evenly spread points in it, which an agent transmits."""

from __future__ import annotations

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.datasets.labelled_cloud import points_at
from cobevglue.typing import BoolArray, Float32Array, IntArray

__all__ = ["select_keypoints", "spread"]

_FINEST = 0.1
"""Side of the first voxels [m]: a car still has some hundred of them."""
_COARSER = 1.25


def select_keypoints(points: Float32Array, proposals: Boxes, margin: float, budget: int) -> Float32Array:
    """Some of the points that lie in a proposal.

    Where the paper takes the furthest points of the whole cloud one after the other and then those in proposals, this
    looks in the proposals first and takes one point of each voxel: as even, and much faster.

    Args:
        points: (N, 4) x, y, z [m], intensity.
        proposals: boxes in the same frame.
        margin: by how much a box is enlarged on every side [m].
        budget: how many points there may be.

    Returns:
        (K, 3) x, y, z [m], in the order of the cloud. The same for the same cloud.
    """
    chosen = points[_in_any(points, proposals, margin), :3]
    return chosen[spread(chosen, budget)]


def spread(points: Float32Array, budget: int) -> IntArray:
    """Rows of at most `budget` points (N, 3), ascending: all, or the first in each of the finest voxels that are few.

    The voxels grow until there are no more of them than the budget.
    """
    rows = np.arange(len(points))
    side = _FINEST
    while len(rows) > budget:
        cell = np.floor((points - points.min(axis=0)) / side).astype(np.int64)
        _, high, wide = cell.max(axis=0) + 1
        _, rows = np.unique((cell[:, 0] * high + cell[:, 1]) * wide + cell[:, 2], return_index=True)
        side *= _COARSER
    ascending: IntArray = np.sort(rows)
    return ascending


def _in_any(points: Float32Array, boxes: Boxes, margin: float) -> BoolArray:
    """(N,) whether a point is in any of the boxes, enlarged by a margin [m]."""
    inside = np.zeros(len(points), dtype=bool)
    for row, (at, local) in enumerate(points_at(points, boxes, margin)):
        inside[at[np.abs(local[:, 2]) <= boxes.size[row, 2] / 2.0 + margin]] = True
    return inside
