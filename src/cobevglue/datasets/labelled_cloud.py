"""One cloud with the objects in it: what detectors are trained and measured on."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.typing import Float32Array, FloatArray, IntArray

__all__ = ["LabelledCloud", "count_points", "points_at"]


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


def points_at(points: Float32Array, boxes: Boxes, margin: float = 0.0) -> Iterator[FloatArray]:
    """For each box the points that it holds seen from above, its edge included, at any height.

    Args:
        points: (N, 4) x, y, z [m], intensity.
        boxes: K boxes in the same frame.
        margin: by how much boxes are enlarged on every side [m].

    Yields:
        (n, 3) x, y, z [m] from the box's centre, x along its heading.
    """
    ordered = points[np.argsort(points[:, 0])]  # so that a box looks only at the slab of points that it spans in x
    reach = np.hypot(boxes.size[:, 0] / 2.0 + margin, boxes.size[:, 1] / 2.0 + margin)
    first = np.searchsorted(ordered[:, 0], boxes.center[:, 0] - reach, side="left")
    last = np.searchsorted(ordered[:, 0], boxes.center[:, 0] + reach, side="right")
    for row in range(len(boxes)):
        offset = ordered[first[row] : last[row], :3] - boxes.center[row]
        c, s = np.cos(boxes.yaw[row]), np.sin(boxes.yaw[row])
        along, across = c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0]
        length, width = boxes.size[row, :2] / 2.0 + margin
        inside = (np.abs(along) <= length) & (np.abs(across) <= width)
        yield np.column_stack([along[inside], across[inside], offset[inside, 2]])


def count_points(points: Float32Array, boxes: Boxes) -> IntArray:
    """Points in each box, its surface included.

    Args:
        points: (N, 4) x, y, z [m], intensity.
        boxes: K boxes in the same frame; one of unknown height (0) counts the points at any height.

    Returns:
        (K,) counts.
    """
    counts = np.zeros(len(boxes), dtype=np.int64)
    for row, inside in enumerate(points_at(points, boxes)):
        height = boxes.size[row, 2] / 2.0
        counts[row] = np.count_nonzero(np.abs(inside[:, 2]) <= height) if height > 0.0 else len(inside)
    return counts
