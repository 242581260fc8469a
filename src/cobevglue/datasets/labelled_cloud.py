"""Point clouds with labelled objects, for training and evaluation of detectors."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from cobevglue.boxes import Boxes, local_coordinates
from cobevglue.typing import Float32Array, FloatArray, IntArray

__all__ = ["LabelledCloud", "count_points", "points_at"]


@dataclass(frozen=True, eq=False, slots=True)
class LabelledCloud:
    """A point cloud with labelled objects.

    Attributes:
        points: (N, 4) x, y, z [m] and intensity [0, 1] in the sensor's frame.
        boxes: K objects in the same frame.
        point_count: (K,) number of points on each object.

    Raises:
        ValueError: wrong shapes.
    """

    points: Float32Array
    boxes: Boxes
    point_count: IntArray

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 4:
            raise ValueError(f"points must have shape (N, 4), got {self.points.shape}")
        if self.point_count.shape != (len(self.boxes),):
            raise ValueError(f"point_count must have shape ({len(self.boxes)},), got {self.point_count.shape}")


def points_at(points: Float32Array, boxes: Boxes, margin: float = 0.0) -> Iterator[tuple[IntArray, FloatArray]]:
    """The points inside the bird's-eye-view rectangle of each box, border included, at any height.

    Args:
        points: (N, 4) x, y, z [m], intensity.
        boxes: K boxes in the same frame.
        margin: enlargement of the boxes on every side [m].

    Yields:
        (n,) rows of these points, and (n, 3) x, y, z [m] from the box's centre, x along its heading.
    """
    order = np.argsort(points[:, 0])  # so that each box is compared only with the slab of points in its x range
    x, y = points[order, 0], points[order, 1]
    reach = np.hypot(boxes.size[:, 0] / 2.0 + margin, boxes.size[:, 1] / 2.0 + margin)
    first = np.searchsorted(x, boxes.center[:, 0] - reach, side="left")
    last = np.searchsorted(x, boxes.center[:, 0] + reach, side="right")
    for row in range(len(boxes)):
        slab = slice(first[row], last[row])
        near = order[slab][np.abs(y[slab] - boxes.center[row, 1]) <= reach[row]]
        local = local_coordinates(points[near, :3], boxes.center[row], boxes.yaw[row])
        inside = (np.abs(local[:, :2]) <= boxes.size[row, :2] / 2.0 + margin).all(axis=1)
        yield near[inside], local[inside]


def count_points(points: Float32Array, boxes: Boxes) -> IntArray:
    """Count the points in each box, surface included.

    Args:
        points: (N, 4) x, y, z [m], intensity.
        boxes: K boxes in the same frame; for boxes of unknown height (0), points at any height are counted.

    Returns:
        (K,) counts.
    """
    counts = np.zeros(len(boxes), dtype=np.int64)
    for row, (_, inside) in enumerate(points_at(points, boxes)):
        height = boxes.size[row, 2] / 2.0
        counts[row] = np.count_nonzero(np.abs(inside[:, 2]) <= height) if height > 0.0 else len(inside)
    return counts
