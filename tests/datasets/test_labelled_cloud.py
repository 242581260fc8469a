"""Points in boxes, and clouds with their labels."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cobevglue import Boxes
from cobevglue.datasets.labelled_cloud import LabelledCloud, count_points, points_at


@pytest.mark.parametrize(
    ("point", "size", "yaw", "count"),
    [
        ((10.0, 0.0, 0.0), (4, 2, 1.5), 0.0, 1),  # the centre
        ((12.0, 1.0, 0.75), (4, 2, 1.5), 0.0, 1),  # a corner belongs to the box
        ((12.1, 0.0, 0.0), (4, 2, 1.5), 0.0, 0),  # ahead of it
        ((10.0, 1.1, 0.0), (4, 2, 1.5), 0.0, 0),  # beside it
        ((10.0, 0.0, 0.8), (4, 2, 1.5), 0.0, 0),  # above it
        ((10.0, 1.9, 0.0), (4, 2, 1.5), math.pi / 2, 1),  # beside it, but it stands across
        ((11.9, 0.0, 0.0), (4, 2, 1.5), math.pi / 2, 0),  # ahead of it, but it stands across
        ((10.0, 0.0, 9.0), (4, 2, 0), 0.0, 1),  # a box of unknown height is as high as you like
    ],
)
def test_points_in_a_box(
    point: tuple[float, float, float], size: tuple[float, float, float], yaw: float, count: int
) -> None:
    points = np.array([[-50, 0, 0, 0], [*point, 0.5], [50, 0, 0, 0]], dtype=np.float32)
    assert count_points(points, Boxes([(10, 0, 0)], [size], [yaw])).tolist() == [count]


def test_points_at_box_use_its_axes_without_height() -> None:
    points = np.array([[10, 1.5, 7, 0], [8.95, 0, 0, 0], [8.4, 0, 0, 0], [50, 0, 0, 0]], dtype=np.float32)
    across = Boxes([(10, 0, 1)], [(4, 2, 1.5)], [math.pi / 2])  # faces along y
    ((rows, found),) = points_at(points, across)
    np.testing.assert_allclose(found, [(1.5, 0, 6)], atol=1e-6)
    assert rows.tolist() == [0]
    ((rows, found),) = points_at(points, across, margin=0.1)
    np.testing.assert_allclose(found, [(0, 1.05, -1), (1.5, 0, 6)], atol=1e-6)
    assert rows.tolist() == [1, 0]


def test_no_points_and_no_boxes() -> None:
    nothing = np.zeros((0, 4), dtype=np.float32)
    assert count_points(nothing, Boxes([(0, 0, 0)], [(4, 2, 1)], [0])).tolist() == [0]
    assert count_points(nothing, Boxes.empty()).shape == (0,)


def test_cloud_with_wrong_shape_is_refused() -> None:
    with pytest.raises(ValueError, match="points must have shape"):
        LabelledCloud(np.zeros((3, 3), dtype=np.float32), Boxes.empty(), np.zeros(0, dtype=np.int64))
    with pytest.raises(ValueError, match="point_count must have shape"):
        LabelledCloud(np.zeros((3, 4), dtype=np.float32), Boxes.empty(), np.zeros(1, dtype=np.int64))
