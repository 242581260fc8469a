"""Augmentation: points and boxes move together."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cobevglue.datasets.labelled_cloud import LabelledCloud, count_points
from cobevglue.training import AugmentationConfig, augment

from .boxes_on_a_plane import BoxesOnAPlane

NOTHING = {"mirror": 0.0, "rotation": 0.0, "scaling": 0.0, "z_shift": 0.0, "drop": 0.0}
SAMPLE: LabelledCloud = BoxesOnAPlane(seed=5).episode(0)[0]


def changed(**settings: float) -> LabelledCloud:
    return augment(SAMPLE, AugmentationConfig(**{**NOTHING, **settings}), np.random.default_rng(1))


@pytest.mark.parametrize(
    "settings",
    [
        {},  # nothing is changed
        {"mirror": 1.0},
        {"rotation": math.pi},
        {"scaling": 0.2},
        {"z_shift": 2.0},
        {"mirror": 1.0, "rotation": 1.0, "scaling": 0.1, "z_shift": 1.0},  # all together
    ],
)
def test_points_stay_in_their_boxes(settings: dict[str, float]) -> None:
    after = changed(**settings)
    # Points within a millimetre of a box's side may round to the other side; the toy scene has a handful.
    slack = after.boxes.replace(size=after.boxes.size + 1e-3)
    assert (count_points(after.points, slack) >= SAMPLE.point_count).all()
    assert (count_points(after.points, slack) - SAMPLE.point_count).max() <= 1
    np.testing.assert_array_equal(after.point_count, SAMPLE.point_count)


def test_nothing_is_changed_where_nothing_shall_be() -> None:
    after = changed()
    np.testing.assert_array_equal(after.points, SAMPLE.points)
    np.testing.assert_array_equal(after.boxes.bev, SAMPLE.boxes.bev)


def test_mirrored_left_turning_car_turns_right() -> None:
    after = changed(mirror=1.0)
    np.testing.assert_allclose(after.boxes.center, SAMPLE.boxes.center * [1, -1, 1])
    np.testing.assert_allclose(after.boxes.yaw, -SAMPLE.boxes.yaw)
    np.testing.assert_allclose(after.points, SAMPLE.points * np.array([1, -1, 1, 1], dtype=np.float32))


def test_dropped_points_lower_the_counts() -> None:
    after = changed(drop=1.0, min_keep=0.5)
    share = len(after.points) / len(SAMPLE.points)
    assert 0.45 < share < 1.0
    np.testing.assert_allclose(after.point_count / SAMPLE.point_count, share, atol=0.1)


def test_the_same_random_numbers_make_the_same_sample() -> None:
    first, second = (augment(SAMPLE, AugmentationConfig(), np.random.default_rng(7)) for _ in range(2))
    np.testing.assert_array_equal(first.points, second.points)
    np.testing.assert_array_equal(first.boxes.bev, second.boxes.bev)
    assert first.points.dtype == np.float32


def test_the_sample_itself_is_left_alone() -> None:
    before = SAMPLE.points.copy()
    changed(mirror=1.0, rotation=1.0, scaling=0.1, z_shift=1.0, drop=1.0)
    np.testing.assert_array_equal(SAMPLE.points, before)
