"""Which boxes a sensor at the origin sees, in the plane: near enough, and not hidden behind others."""

from __future__ import annotations

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.se2 import wrap_angle
from cobevglue.typing import BoolArray, FloatArray

__all__ = ["is_visible", "visible_fraction"]

_RAYS_PER_BOX = 9


def is_visible(boxes: Boxes, max_range: float, min_fraction: float) -> BoolArray:
    """(N,) whether a sensor at the origin sees each box: centre within `max_range` [m], enough of it not hidden."""
    distance = np.hypot(boxes.center[:, 0], boxes.center[:, 1])
    return (distance <= max_range) & (visible_fraction(boxes) >= min_fraction)


def visible_fraction(boxes: Boxes) -> FloatArray:
    """(N,) the part of each box's angular width that no other box covers, seen from the origin.

    Footprints block the view whatever their height, so that this is a little stricter than a LiDAR on a roof.
    """
    n = len(boxes)
    if n == 0:
        return np.zeros(0)
    corners = boxes.bev_corners()
    bearing = np.arctan2(boxes.center[:, 1], boxes.center[:, 0])
    offset = wrap_angle(np.arctan2(corners[..., 1], corners[..., 0]) - bearing[:, None])
    share = (np.arange(_RAYS_PER_BOX) + 0.5) / _RAYS_PER_BOX  # the middle of each ray's part of the width
    low, high = offset.min(axis=1)[:, None], offset.max(axis=1)[:, None]
    angle = bearing[:, None] + low + share * (high - low)

    hit = _distance_to(boxes, np.stack([np.cos(angle), np.sin(angle)], axis=-1))  # (N boxes aimed at, rays, N boxes)
    own = hit[np.arange(n), :, np.arange(n)]
    hit[np.arange(n), :, np.arange(n)] = np.inf
    fraction: FloatArray = (own <= hit.min(axis=-1)).mean(axis=1)
    return fraction


def _distance_to(boxes: Boxes, direction: FloatArray) -> FloatArray:
    """(..., N) how far along each ray (..., 2) from the origin each footprint begins [m]; infinite where it misses."""
    c, s = np.cos(boxes.yaw), np.sin(boxes.yaw)
    # Origin and rays in each footprint's own axes, where it is an interval along each axis (the slab method).
    origin = np.stack(
        [-c * boxes.center[:, 0] - s * boxes.center[:, 1], s * boxes.center[:, 0] - c * boxes.center[:, 1]]
    )
    dx, dy = direction[..., 0, None], direction[..., 1, None]
    ray = (c * dx + s * dy, -s * dx + c * dy)
    enter, leave = np.full(ray[0].shape, -np.inf), np.full(ray[0].shape, np.inf)
    for axis in (0, 1):
        half = boxes.size[:, axis] / 2.0
        # A ray along a slab never crosses its sides; the smallest step instead of zero sends them to +-infinity.
        step = np.where(np.abs(ray[axis]) < 1e-12, 1e-12, ray[axis])
        first, second = (-half - origin[axis]) / step, (half - origin[axis]) / step
        enter, leave = np.maximum(enter, np.minimum(first, second)), np.minimum(leave, np.maximum(first, second))
    return np.where((enter <= leave) & (leave > 0.0), np.maximum(enter, 0.0), np.inf)
