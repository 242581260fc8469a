"""Height, roll and pitch from matched heights, against rotations by scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from cobevglue import SE2, Alignment, Boxes
from cobevglue.alignment import Levelling, LevellingConfig, LevellingFilter, estimate_levelling
from cobevglue.alignment.procrustes import procrustes
from cobevglue.typing import FloatArray

POSE = SE2(12.0, -7.0, 0.8)
"""Of the level frame of the other, in all scenes."""
EIGHT = ((10, -4), (14, 6), (20, -9), (24, 3), (30, -2), (33, 8), (38, -6), (45, 4))
EXACT = LevellingConfig(height_std=0.01, z_std=100.0, tilt_std=3.0)


def oracle(z: float, roll: float, pitch: float) -> tuple[Rotation, FloatArray]:
    """Rotation (about fixed axes: x, then y) and translation from the other's frame to its level frame."""
    return Rotation.from_rotvec([0.0, pitch, 0.0]) * Rotation.from_rotvec([roll, 0.0, 0.0]), np.array([0.0, 0.0, z])


def views(
    places: object, z: float, roll: float, pitch: float, rng: np.random.Generator | None = None, std: float = 0.1
) -> tuple[Boxes, Boxes, Alignment]:
    """Cars 1.1 m below the ego's LiDAR at (x, y) [m] of the level frame: seen by both, and their match."""
    xy = np.array(places, dtype=float)
    n = len(xy)
    level = np.column_stack([xy, np.full(n, -1.1)])
    rotation, shift = oracle(z, roll, pitch)
    centers = [POSE.apply(level), rotation.inv().apply(level - shift)]
    if rng is not None:
        centers = [c + np.column_stack([np.zeros((n, 2)), rng.normal(0.0, std, n)]) for c in centers]
    ego, other = (Boxes(c, np.tile((4.5, 1.9, 1.6), (n, 1)), np.zeros(n)) for c in centers)
    return ego, other, Alignment(POSE, np.column_stack([np.arange(n), np.arange(n)]))


def state(found: Levelling) -> FloatArray:
    return np.array([found.z, found.roll, found.pitch])


def test_mast_pitched_by_ten_degrees() -> None:
    """A mast 5 m above the ego's LiDAR, eight cars, heights to 0.1 m in each list: to 0.3 m and 1 degree."""
    rng = np.random.default_rng([0, 0, 0])
    found = estimate_levelling(*views(EIGHT, 5.0, 0.0, math.radians(10.0), rng))
    assert found.z == pytest.approx(5.0, abs=0.3)
    assert found.pitch == pytest.approx(math.radians(10.0), abs=math.radians(1.0))
    assert found.roll == pytest.approx(0.0, abs=math.radians(1.0))
    assert found.observable == (True, True, True)
    assert found.pairs == 8


def test_no_slope_gives_zero() -> None:
    found = estimate_levelling(*views(EIGHT, 0.0, 0.0, 0.0))
    np.testing.assert_allclose(state(found), 0.0, atol=1e-9)


def test_roll_about_a_line_is_unobservable() -> None:
    """Cars in a row along x tell the pitch; the roll keeps its prior."""
    config = LevellingConfig()
    found = estimate_levelling(*views([(10, 0), (20, 0), (30, 0), (40, 0)], 1.0, 0.0, 0.05), config)
    assert found.observable == (True, False, True)
    assert found.pitch == pytest.approx(0.05, abs=2e-3)
    assert math.sqrt(found.covariance[1, 1]) == pytest.approx(config.tilt_std, rel=0.01)


def test_an_oblique_row_leaves_both_angles_open() -> None:
    """Only the tilt along the row is known, and neither roll nor pitch is that."""
    found = estimate_levelling(*views([(10, 10), (20, 20), (30, 30), (40, 40)], 1.0, 0.0, 0.05))
    assert found.observable[1:] == (False, False)


@pytest.mark.parametrize(
    ("places", "observable"),
    [([(8, 2)], (True, False, False)), ([(8, 2), (30, -6)], (True, False, False))],
    ids=["one", "two"],
)
def test_below_three_pairs_only_z_is_observable(places: object, observable: tuple[bool, bool, bool]) -> None:
    assert estimate_levelling(*views(places, 1.0, 0.0, 0.0)).observable == observable


def test_a_refused_alignment_leaves_the_prior() -> None:
    ego, other, _ = views(EIGHT, 5.0, 0.0, 0.1)
    refused = Alignment.refused("ambiguous")
    found = estimate_levelling(ego, other, refused)
    assert (found.observable, found.pairs) == ((False, False, False), 0)
    np.testing.assert_array_equal(state(found), 0.0)
    with pytest.raises(ValueError, match="no pose: ambiguous"):
        found.ego_SE3_other(refused, other)
    with pytest.raises(ValueError, match="no pose: ambiguous"):
        found.boxes_in_ego(refused, other)


def test_pairs_of_unknown_height_are_not_used() -> None:
    """Lists without heights have z = 0 in all rows: that is no level road."""
    ego, other, alignment = views(EIGHT, 5.0, 0.0, 0.1)
    flat = other.replace(size=other.size * (1.0, 1.0, 0.0), center=other.center * (1.0, 1.0, 0.0))
    assert estimate_levelling(ego, flat, alignment).pairs == 0


def test_one_wrong_height_hardly_counts() -> None:
    """The farthest car is matched with a lorry whose centre is 1 m higher."""
    ego, other, alignment = views(EIGHT, 5.0, 0.02, 0.1, np.random.default_rng([1, 0, 0]), std=0.05)
    center = ego.center.copy()
    center[-1, 2] += 1.0
    right = estimate_levelling(ego, other, alignment)
    wrong = estimate_levelling(ego.replace(center=center), other, alignment)
    assert np.abs(state(wrong) - state(right))[1:].max() < math.radians(0.5)
    assert abs(wrong.z - right.z) < 0.1


def test_matches_beyond_the_rows_are_named() -> None:
    ego, other, _ = views(EIGHT, 5.0, 0.0, 0.1)
    with pytest.raises(ValueError, match=r"matches: row 1 is \[0, 8\], but other has 8 boxes"):
        estimate_levelling(ego, other, Alignment(POSE, np.array([[0, 0], [0, 8]])))


tilts = st.floats(-0.2, 0.2)


@given(z=st.floats(-6.0, 6.0), roll=tilts, pitch=tilts, seed=st.integers(0, 10**6))
@settings(max_examples=60, deadline=None)
def test_exact_heights_give_the_exact_tilt(z: float, roll: float, pitch: float, seed: int) -> None:
    places = np.random.default_rng([seed, 0, 0]).uniform((0.0, -20.0), (50.0, 20.0), (10, 2))
    found = estimate_levelling(*views(places, z, roll, pitch), EXACT)
    np.testing.assert_allclose(state(found), (z, roll, pitch), atol=1e-4)


def test_boxes_and_pose_in_space() -> None:
    """The planar pose is fitted to the tilted boxes; the pose in space and the levelled boxes are right."""
    z, roll, pitch = 5.0, 0.05, math.radians(10.0)
    ego, other, true = views(EIGHT, z, roll, pitch)
    found = estimate_levelling(ego, other, true, EXACT)
    rotation, shift = oracle(z, roll, pitch)
    np.testing.assert_allclose(found.level_SE3_other[:3, :3], rotation.as_matrix(), atol=1e-5)
    np.testing.assert_allclose(found.level(other).center, rotation.apply(other.center.copy()) + shift, atol=1e-3)
    # What an aligner finds: the planar motion that carries the tilted boxes onto the ego's.
    planar = Alignment(procrustes(ego.center[:, :2], other.center[:, :2]), true.matches)
    assert planar.ego_SE2_other is not None
    assert planar.ego_SE2_other.error_to(POSE)[0] > 0.5
    assert found.ego_SE2_level(planar, other).error_to(POSE) == pytest.approx((0.0, 0.0), abs=0.02)
    np.testing.assert_allclose(found.boxes_in_ego(planar, other).center, ego.center, atol=0.02)
    np.testing.assert_allclose(found.ego_SE3_other(planar, other)[:3, 3], (POSE.x, POSE.y, z), atol=0.02)


def test_covariance_is_consistent() -> None:
    """The mean NEES of 200 seeded cases is within the 99.8 % interval of chi-squared; heights of points likewise."""
    config = LevellingConfig(height_std=0.1 * math.sqrt(2.0))
    nees, heights, cases = [], [], 200
    point = np.array([[60.0, 10.0, -6.0]])
    for index in range(cases):
        rng = np.random.default_rng([2, 0, index])
        truth = rng.normal(0.0, (config.z_std, config.tilt_std, config.tilt_std))
        places = rng.uniform((0.0, -15.0), (40.0, 15.0), (int(rng.integers(3, 15)), 2))
        found = estimate_levelling(*views(places, truth[0], truth[1], truth[2], rng), config)
        error = state(found) - truth
        nees.append(error @ np.linalg.solve(found.covariance, error))
        rotation, shift = oracle(*truth)
        gap = found.level_SE3_other[2] @ np.append(point[0], 1.0) - (rotation.apply(point)[0] + shift)[2]
        heights.append((gap / found.height_std(point)[0]) ** 2)
    low, high = chi2.ppf((0.001, 0.999), 3 * cases) / cases
    assert low < np.mean(nees) < high
    low, high = chi2.ppf((0.001, 0.999), cases) / cases
    assert low < np.mean(heights) < high


def test_filter_accumulates_information_over_frames() -> None:
    """Two cars in a frame never make a plane; those of four frames do."""
    levelling = LevellingFilter(LevellingConfig(correlation=1.0))
    for first in range(0, 8, 2):
        found = levelling.update(*views(EIGHT[first : first + 2], 5.0, 0.03, 0.1))
    assert found.observable == (True, True, True)
    # Frame by frame is the same as all at once, but for second-order terms of the tilt and what the prior pulls.
    together = estimate_levelling(*views(EIGHT, 5.0, 0.03, 0.1))
    np.testing.assert_allclose(state(found), state(together), atol=0.05)
    np.testing.assert_allclose(found.covariance, together.covariance, rtol=0.2, atol=1e-4)
    levelling.reset()
    assert levelling.levelling.pairs == 0


def test_correlated_frames_count_less() -> None:
    """With a correlation of 3, three equal frames are worth one."""
    frame = views(EIGHT, 5.0, 0.0, 0.05)
    levelling = LevellingFilter()
    for _ in range(3):
        found = levelling.update(*frame)
    np.testing.assert_allclose(found.covariance, estimate_levelling(*frame).covariance, rtol=0.05, atol=1e-6)
