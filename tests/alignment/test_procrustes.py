"""The rigid motion between two matched point sets, against hand arithmetic and scipy."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cobevglue import SE2
from cobevglue.alignment.procrustes import procrustes
from cobevglue.se2 import wrap_angle
from cobevglue.typing import FloatArray

from .scenes import random_pose


def by_scipy(ego: FloatArray, other: FloatArray) -> SE2:
    """The same by scipy's solution of Wahba's problem. Far points on the z axis leave a rotation about z only."""
    ego_center, other_center = ego.mean(axis=0), other.mean(axis=0)
    up = np.array([[0.0, 0.0, 1e4], [0.0, 0.0, -1e4]])
    a = np.vstack([np.column_stack([ego - ego_center, np.zeros(len(ego))]), up])
    b = np.vstack([np.column_stack([other - other_center, np.zeros(len(other))]), up])
    rotation, _ = Rotation.align_vectors(a, b)
    yaw = float(rotation.as_euler("zyx")[0])
    turned = SE2(0.0, 0.0, yaw).apply(other_center)
    return SE2(ego_center[0] - turned[0], ego_center[1] - turned[1], yaw)


def test_the_direction_is_from_other_to_ego() -> None:
    """Two points straight ahead of other lie to the left of (5, 1) in ego's frame: other looks along ego's y there."""
    ego, other = np.array([[5.0, 1.0], [5.0, 3.0]]), np.array([[10.0, 0.0], [12.0, 0.0]])
    ego_SE2_other = procrustes(ego, other)
    assert ego_SE2_other.yaw == pytest.approx(math.pi / 2)
    assert (ego_SE2_other.x, ego_SE2_other.y) == pytest.approx((5.0, -9.0))
    np.testing.assert_allclose(ego_SE2_other.apply(other), ego, atol=1e-12)


def test_least_squares_by_hand() -> None:
    """Points that are farther apart in one frame than in the other: no turn, and the centres meet."""
    ego_SE2_other = procrustes(np.array([[0.0, 0.0], [4.0, 0.0]]), np.array([[1.0, 7.0], [3.0, 7.0]]))
    assert ego_SE2_other.error_to(SE2(0.0, -7.0, 0.0)) == pytest.approx((0.0, 0.0), abs=1e-12)


@pytest.mark.parametrize("points", [[[3.0, -2.0]], [[3.0, -2.0]] * 4], ids=["one", "four in one place"])
def test_a_single_place_leaves_the_rotation_at_zero(points: list[list[float]]) -> None:
    ego_SE2_other = procrustes(np.array(points), np.array(points) + (10.0, 5.0))
    assert ego_SE2_other.error_to(SE2(-10.0, -5.0, 0.0)) == pytest.approx((0.0, 0.0), abs=1e-9)


@given(seed=st.integers(0, 10**6), n=st.integers(2, 12))
@settings(max_examples=50, deadline=None)
def test_exact_points_give_the_exact_pose(seed: int, n: int) -> None:
    rng = np.random.default_rng([seed, 0, 0])
    other, truth = rng.uniform(-50.0, 50.0, (n, 2)), random_pose(rng, reach=500.0)
    distance, turn = procrustes(truth.apply(other), other).error_to(truth)
    assert distance < 1e-8
    assert turn < 1e-9


@given(seed=st.integers(0, 10**6), n=st.integers(2, 12), noise=st.sampled_from([0.1, 1.0, 10.0]))
@settings(max_examples=50, deadline=None)
def test_noisy_points_as_scipy_does(seed: int, n: int, noise: float) -> None:
    rng = np.random.default_rng([seed, 1, 0])
    other = rng.uniform(-50.0, 50.0, (n, 2))
    ego = random_pose(rng).apply(other) + rng.normal(0.0, noise, (n, 2))
    distance, turn = procrustes(ego, other).error_to(by_scipy(ego, other))
    assert distance < 1e-5
    assert turn < 1e-6


@given(seed=st.integers(0, 10**6), n=st.integers(3, 10))
@settings(max_examples=30, deadline=None)
def test_a_mirror_image_is_turned_never_reflected(seed: int, n: int) -> None:
    """The best proper rotation of a mirrored set, by trying all of them; a reflection would fit without any error."""
    rng = np.random.default_rng([seed, 2, 0])
    other = rng.uniform(-50.0, 50.0, (n, 2))
    ego = other * (1.0, -1.0)

    def squared_error(pose: SE2) -> float:
        return float(((pose.apply(other) - ego) ** 2).sum())

    def at(yaw: float) -> SE2:
        x, y = ego.mean(axis=0) - SE2(0.0, 0.0, yaw).apply(other.mean(axis=0))
        return SE2(x, y, yaw)

    found = procrustes(ego, other)
    best = min(squared_error(at(yaw)) for yaw in np.linspace(-math.pi, math.pi, 721))
    assert squared_error(found) <= best * (1.0 + 1e-9) + 1e-9
    corners = found.apply([[0.0, 0.0], [1.0, 0.0], [0.0, 1.0]])
    assert np.linalg.det(corners[1:] - corners[0]) == pytest.approx(1.0), "a unit square keeps its handedness"


@given(seed=st.integers(0, 10**6))
@settings(max_examples=30, deadline=None)
def test_swapping_the_roles_inverts_the_pose(seed: int) -> None:
    rng = np.random.default_rng([seed, 3, 0])
    ego, other = rng.uniform(-50.0, 50.0, (2, 6, 2))
    a, b = procrustes(ego, other), procrustes(other, ego).inverse()
    assert a.error_to(b)[0] < 1e-8
    assert abs(float(wrap_angle(a.yaw - b.yaw))) < 1e-9
