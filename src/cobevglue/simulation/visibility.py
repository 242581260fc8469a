"""Visibility of boxes from a sensor at the origin in the bird's-eye view: range and occlusion."""

from __future__ import annotations

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.se2 import wrap_angle
from cobevglue.typing import BoolArray, FloatArray

__all__ = ["is_visible", "visible_fraction"]

_RAYS_PER_BOX = 9


def is_visible(boxes: Boxes, max_range: float, min_fraction: float) -> BoolArray:
    """(N,) whether each box's centre is within `max_range` [m] and its visible fraction is at least `min_fraction`."""
    distance = np.hypot(boxes.center[:, 0], boxes.center[:, 1])
    return (distance <= max_range) & (visible_fraction(boxes) >= min_fraction)


def visible_fraction(boxes: Boxes) -> FloatArray:
    """(N,) fraction of each box's angular width from the origin that no other box occludes.

    Footprints occlude whatever their height, so this is slightly stricter than for a LiDAR on a roof.
    """
    n = len(boxes)
    if n == 0:
        return np.zeros(0)
    corners = boxes.bev_corners()
    bearing = np.arctan2(boxes.center[:, 1], boxes.center[:, 0])
    offset = wrap_angle(np.arctan2(corners[..., 1], corners[..., 0]) - bearing[:, None])
    share = (np.arange(_RAYS_PER_BOX) + 0.5) / _RAYS_PER_BOX  # rays at the centres of equal parts of the width
    low, high = offset.min(axis=1)[:, None], offset.max(axis=1)[:, None]
    angle = bearing[:, None] + low + share * (high - low)

    hit = _distance_to(boxes, np.stack([np.cos(angle), np.sin(angle)], axis=-1))  # (N boxes aimed at, rays, N boxes)
    own = hit[np.arange(n), :, np.arange(n)]
    hit[np.arange(n), :, np.arange(n)] = np.inf
    fraction: FloatArray = (own <= hit.min(axis=-1)).mean(axis=1)
    return fraction


def _distance_to(boxes: Boxes, direction: FloatArray) -> FloatArray:
    """(..., N) distance [m] to each footprint along rays (..., 2) from the origin; infinite without intersection."""
    c, s = np.cos(boxes.yaw), np.sin(boxes.yaw)
    # Slab method: origin and rays in the frame of each footprint, where it is an interval along each axis.
    origin = np.stack(
        [-c * boxes.center[:, 0] - s * boxes.center[:, 1], s * boxes.center[:, 0] - c * boxes.center[:, 1]]
    )
    dx, dy = direction[..., 0, None], direction[..., 1, None]
    ray = (c * dx + s * dy, -s * dx + c * dy)
    enter, leave = np.full(ray[0].shape, -np.inf), np.full(ray[0].shape, np.inf)
    for axis in (0, 1):
        half = boxes.size[:, axis] / 2.0
        # A tiny step instead of zero moves the intersections of rays parallel to a slab to about +-infinity.
        step = np.where(np.abs(ray[axis]) < 1e-12, 1e-12, ray[axis])
        first, second = (-half - origin[axis]) / step, (half - origin[axis]) / step
        enter, leave = np.maximum(enter, np.minimum(first, second)), np.minimum(leave, np.maximum(first, second))
    return np.where((enter <= leave) & (leave > 0.0), np.maximum(enter, 0.0), np.inf)
