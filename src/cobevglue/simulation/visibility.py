"""Visibility of boxes from a sensor at the origin in the bird's-eye view: range and occlusion."""

from __future__ import annotations

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.se2 import wrap_angle
from cobevglue.typing import BoolArray, FloatArray, IntArray

__all__ = ["is_visible", "visible_fraction"]

_RAYS_PER_BOX = 9


def is_visible(boxes: Boxes, max_range: float, min_fraction: float, over_tops: bool = False) -> BoolArray:
    """(N,) whether each box's centre is within `max_range` [m] and its visible fraction is at least `min_fraction`.

    See `visible_fraction` for `over_tops`.
    """
    distance = np.hypot(boxes.center[:, 0], boxes.center[:, 1])
    return (distance <= max_range) & (visible_fraction(boxes, over_tops) >= min_fraction)


def visible_fraction(boxes: Boxes, over_tops: bool = False) -> FloatArray:
    """(N,) fraction of each box's angular width from the origin that no other box occludes.

    Args:
        boxes: in the frame of the sensor.
        over_tops: the sensor looks over what is below its line of sight to the upper edge of a box's near side, as from
            a mast; z and heights must be known. Otherwise footprints occlude whatever their height, which is slightly
            stricter than for a LiDAR on a roof.
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

    rays = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    aimed, hit = _pairs_in_line(boxes, bearing, np.abs(offset).max(axis=1))
    enter, leave = _crossings(boxes.bev[hit], rays[aimed])  # (P, rays)
    own = np.empty((n, _RAYS_PER_BOX))
    own[aimed[aimed == hit]] = enter[aimed == hit]
    before = (enter < own[aimed]) & (aimed != hit)[:, None]
    if over_tops:
        # Height of the line of sight for each metre of distance; it is lowest where it enters or leaves a footprint.
        top = boxes.center[:, 2] + boxes.size[:, 2] / 2.0
        slope = top[aimed, None] / np.maximum(own[aimed], 1e-6)
        before &= np.minimum(slope * enter, slope * np.minimum(leave, own[aimed])) < top[hit, None]
    hidden = np.zeros((n, _RAYS_PER_BOX), dtype=bool)
    np.logical_or.at(hidden, aimed, before)
    fraction: FloatArray = 1.0 - hidden.mean(axis=1)
    return fraction


def _pairs_in_line(boxes: Boxes, bearing: FloatArray, half_width: FloatArray) -> tuple[IntArray, IntArray]:
    """(P,) rows of boxes aimed at and (P,) of boxes that a ray there may hit on the way, themselves included.

    Args:
        boxes: N boxes in the frame of the sensor.
        bearing: (N,) of their centres [rad].
        half_width: (N,) largest angle between a centre and a corner [rad].
    """
    overlap = np.abs(wrap_angle(bearing[:, None] - bearing)) <= half_width[:, None] + half_width + 1e-9
    distance = np.hypot(boxes.center[:, 0], boxes.center[:, 1])
    radius = np.hypot(boxes.size[:, 0], boxes.size[:, 1]) / 2.0
    nearer = (distance - radius) <= (distance + radius)[:, None]
    aimed, hit = np.nonzero(overlap & nearer)
    return aimed, hit


def _crossings(footprint: FloatArray, direction: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(P, K) distances [m] at which K rays from the origin enter and leave the footprint of each of P boxes.

    Without an intersection both are infinite; rays from inside a footprint enter it at 0.

    Args:
        footprint: (P, 5) x, y, length, width, yaw.
        direction: (P, K, 2) unit vectors of the rays.
    """
    x, y, length, width, yaw = footprint.T[..., None]
    c, s = np.cos(yaw), np.sin(yaw)
    # Slab method: origin and rays in the frame of each footprint, where it is an interval along each axis.
    origin = (-c * x - s * y, s * x - c * y)
    dx, dy = direction[..., 0], direction[..., 1]
    ray = (c * dx + s * dy, -s * dx + c * dy)
    enter, leave = np.full(dx.shape, -np.inf), np.full(dx.shape, np.inf)
    for axis, half in enumerate((length / 2.0, width / 2.0)):
        # A tiny step instead of zero moves the intersections of rays parallel to a slab to about +-infinity.
        step = np.where(np.abs(ray[axis]) < 1e-12, 1e-12, ray[axis])
        first, second = (-half - origin[axis]) / step, (half - origin[axis]) / step
        enter, leave = np.maximum(enter, np.minimum(first, second)), np.minimum(leave, np.maximum(first, second))
    met = (enter <= leave) & (leave > 0.0)
    return np.where(met, np.maximum(enter, 0.0), np.inf), np.where(met, leave, np.inf)
