"""One cloud with the objects in it: what detectors are trained and measured on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.typing import Float32Array, IntArray

__all__ = ["LabelledCloud", "count_points"]


@dataclass(frozen=True, eq=False, slots=True)
class LabelledCloud:
    """One cloud and the objects in it.

    Attributes:
        points: (N, 4) x, y, z [m] and intensity [0, 1] in the sensor's frame.
        boxes: K objects in the same frame.
        point_count: (K,) points on each object.

    Raises:
        ValueError: a wrong shape.
    """

    points: Float32Array
    boxes: Boxes
    point_count: IntArray

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 4:
            raise ValueError(f"points must have shape (N, 4), got {self.points.shape}")
        if self.point_count.shape != (len(self.boxes),):
            raise ValueError(f"point_count must have shape ({len(self.boxes)},), got {self.point_count.shape}")


def count_points(points: Float32Array, boxes: Boxes) -> IntArray:
    """Points in each box, its surface included.

    Args:
        points: (N, 4) x, y, z [m], intensity.
        boxes: K boxes in the same frame; one of unknown height (0) counts the points at any height.

    Returns:
        (K,) counts.
    """
    ordered = points[np.argsort(points[:, 0])]  # so that a box looks only at the slab of points that it spans in x
    reach = np.hypot(boxes.size[:, 0], boxes.size[:, 1]) / 2.0
    first = np.searchsorted(ordered[:, 0], boxes.center[:, 0] - reach, side="left")
    last = np.searchsorted(ordered[:, 0], boxes.center[:, 0] + reach, side="right")
    counts = np.zeros(len(boxes), dtype=np.int64)
    for row in range(len(boxes)):
        offset = ordered[first[row] : last[row], :3] - boxes.center[row]
        c, s = np.cos(boxes.yaw[row]), np.sin(boxes.yaw[row])
        length, width, height = boxes.size[row] / 2.0
        inside = (np.abs(c * offset[:, 0] + s * offset[:, 1]) <= length) & (
            np.abs(c * offset[:, 1] - s * offset[:, 0]) <= width
        )
        if height > 0.0:
            inside &= np.abs(offset[:, 2]) <= height
        counts[row] = np.count_nonzero(inside)
    return counts
