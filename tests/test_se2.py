"""SE2: small cases that can be checked by hand, and the properties that make it a group."""

from __future__ import annotations

import copy
import math
import pickle
from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from cobevglue.se2 import SE2, wrap_angle

QUARTER = math.pi / 2

coordinates = st.floats(-1e3, 1e3)
angles = st.floats(-10.0, 10.0)
transforms = st.builds(SE2, coordinates, coordinates, angles)
points = st.lists(st.tuples(coordinates, coordinates), min_size=1, max_size=5).map(np.array)


def same(a: SE2, b: SE2) -> bool:
    distance, turn = a.error_to(b)
    return distance < 1e-8 and turn < 1e-9


@pytest.mark.parametrize(
    ("transform", "point", "expected", "why"),
    [
        (SE2(), [3, 4], [3, 4], "the identity moves nothing"),
        (SE2(10, 0, 0), [3, 4], [13, 4], "a translation along x adds to x"),
        (SE2(0, 10, 0), [3, 4], [3, 14], "and along y to y"),
        (SE2(0, 0, QUARTER), [1, 0], [0, 1], "a quarter turn takes forward to left: yaw turns x towards y"),
        (SE2(0, 0, QUARTER), [0, 1], [-1, 0], "and left to backward"),
        (SE2(0, 0, math.pi), [3, 4], [-3, -4], "half a turn negates"),
        (SE2(10, 0, QUARTER), [1, 0], [10, 1], "rotation comes first, then translation"),
        (SE2(10, 20, -QUARTER), [1, 0], [10, 19], "a negative yaw turns to the right"),
        (SE2(10, 0, QUARTER), [1, 0, 7], [10, 1, 7], "z is passed through"),
    ],
)
def test_apply_maps_source_to_destination_point(
    transform: SE2, point: list[float], expected: list[float], why: str
) -> None:
    np.testing.assert_allclose(transform.apply(point), expected, atol=1e-12, err_msg=why)
    np.testing.assert_allclose(transform.inverse().apply(expected), point, atol=1e-12, err_msg="the inverse moves back")


def test_frames_in_names_chain() -> None:
    """A car at (10, 5) facing left sees something 2 m ahead: in the world that is at (10, 7)."""
    world_SE2_ego = SE2(10, 5, QUARTER)
    world_SE2_other = SE2(10, 25, -QUARTER)
    np.testing.assert_allclose(world_SE2_ego.apply([2, 0]), [10, 7], atol=1e-12)
    ego_SE2_other = world_SE2_ego.inverse() @ world_SE2_other
    assert same(ego_SE2_other, SE2(20, 0, math.pi)), "the other is 20 m ahead of the ego and faces it"
    np.testing.assert_allclose(ego_SE2_other.apply([0, 0]), [20, 0], atol=1e-12)


@pytest.mark.parametrize("shape", [(2,), (3,), (5, 2), (5, 3), (4, 5, 2), (0, 2), (0, 3)])
def test_apply_keeps_the_shape_and_the_argument(shape: tuple[int, ...]) -> None:
    given_points = np.ones(shape)
    assert SE2(1, 2, 3).apply(given_points).shape == shape
    assert (given_points == 1).all()


@given(transforms, points)
def test_apply_agrees_with_the_matrix(transform: SE2, p: np.ndarray) -> None:
    homogeneous = np.column_stack([p, np.ones(len(p))])
    np.testing.assert_allclose(transform.apply(p), (homogeneous @ transform.matrix().T)[:, :2], atol=1e-9)


@given(transforms)
def test_transform_and_inverse_cancel_on_both_sides(transform: SE2) -> None:
    assert same(transform @ transform.inverse(), SE2())
    assert same(transform.inverse() @ transform, SE2())
    assert same(transform.inverse().inverse(), transform)


@given(transforms, transforms, transforms)
def test_composition_is_associative(a: SE2, b: SE2, c: SE2) -> None:
    assert same((a @ b) @ c, a @ (b @ c))


@given(transforms, transforms, points)
def test_composition_is_applying_one_after_the_other(a: SE2, b: SE2, p: np.ndarray) -> None:
    np.testing.assert_allclose((a @ b).apply(p), a.apply(b.apply(p)), atol=1e-8)
    np.testing.assert_allclose((a @ b).matrix(), a.matrix() @ b.matrix(), atol=1e-8)


@given(transforms)
def test_a_matrix_comes_back(transform: SE2) -> None:
    assert same(SE2.from_matrix(transform.matrix()), transform)
    spatial = np.eye(4)
    spatial[:2, :2], spatial[:2, 3], spatial[2, 3] = transform.rotation, transform.translation, 1.9
    assert same(SE2.from_matrix(spatial), transform), "z is dropped"


def test_roll_and_pitch_are_dropped() -> None:
    pitch = 0.05
    spatial = np.eye(4)
    spatial[0, 0] = spatial[2, 2] = math.cos(pitch)
    spatial[0, 2], spatial[2, 0] = math.sin(pitch), -math.sin(pitch)
    assert SE2.from_matrix(spatial).yaw == pytest.approx(0.0)


@pytest.mark.parametrize(
    ("matrix", "expected"),
    [
        (np.eye(2), r"must be \(3, 3\) or \(4, 4\), got \(2, 2\)"),
        (np.zeros((3, 4)), r"got \(3, 4\)"),
        (np.diag([2.0, 2.0, 1.0]), "orthonormal"),
        (np.diag([1.0, -1.0, 1.0]), "proper rotation"),
        (np.diag([1.0, -1.0, 1.0, 1.0]), "proper rotation"),
        (np.diag([1.0, math.nan, 1.0]), "finite"),
        ([[1, 0, math.inf], [0, 1, 0], [0, 0, 1]], "finite"),
        (SE2(5, 6, 0.3).matrix().T, "last row of zeros and a one"),
        (np.diag([1.0, 1.0, 2.0]), "last row of zeros and a one"),
    ],
)
def test_non_planar_transform_is_refused(matrix: Any, expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        SE2.from_matrix(matrix)


@pytest.mark.parametrize("field", ["x", "y", "yaw"])
@pytest.mark.parametrize("value", [math.nan, math.inf, -math.inf, "far", None, [1.0, 2.0]])
def test_non_finite_component_is_refused_by_name(field: str, value: Any) -> None:
    with pytest.raises(ValueError, match=rf"SE2\.{field} must be"):
        SE2(**{field: value})


@pytest.mark.parametrize("shape", [(), (1,), (4,), (2, 4)])
def test_points_of_another_dimension_are_refused(shape: tuple[int, ...]) -> None:
    with pytest.raises(ValueError, match="points must be"):
        SE2().apply(np.zeros(shape))


@pytest.mark.parametrize(
    ("angle", "expected"),
    [
        (0.0, 0.0),
        (math.pi, -math.pi),
        (-math.pi, -math.pi),
        (3 * math.pi / 2, -QUARTER),
        (-3 * math.pi / 2, QUARTER),
        (2 * math.pi, 0.0),
        (7 * math.pi, -math.pi),
    ],
)
def test_wrap_angle_keeps_the_direction(angle: float, expected: float) -> None:
    assert wrap_angle(angle) == pytest.approx(expected, abs=1e-12)


@given(st.floats(-1e6, 1e6))
@example(float(np.nextafter(-math.pi, -4)))  # its remainder rounds to 2 pi
def test_wrapped_angle_is_in_interval_with_same_direction(angle: float) -> None:
    for wrapped in (float(wrap_angle(angle)), (SE2(yaw=angle) @ SE2()).yaw):
        assert -math.pi <= wrapped < math.pi
        assert math.cos(wrapped - angle) == pytest.approx(1.0)


def test_wrap_angle_works_elementwise() -> None:
    expected = np.array([[0.0, 0.0], [3.0, 4.0 - 2 * math.pi]])
    np.testing.assert_allclose(wrap_angle([[0.0, 2 * math.pi], [3.0, 4.0]]), expected, atol=1e-12)


@pytest.mark.parametrize(
    ("a", "b", "distance", "turn"),
    [
        (SE2(), SE2(), 0, 0),
        (SE2(3, 4), SE2(), 5, 0),
        (SE2(yaw=0.1), SE2(yaw=-0.1), 0, 0.2),
        (SE2(yaw=math.pi - 0.1), SE2(yaw=-math.pi + 0.1), 0, 0.2),
        (SE2(yaw=2 * math.pi), SE2(), 0, 0),
        (SE2(yaw=math.pi), SE2(), 0, math.pi),
    ],
)
def test_the_error_is_distance_and_the_shorter_turn(a: SE2, b: SE2, distance: float, turn: float) -> None:
    assert a.error_to(b) == pytest.approx((distance, turn), abs=1e-12)
    assert b.error_to(a) == pytest.approx((distance, turn), abs=1e-12)


def test_se2_is_immutable_hashable_and_picklable() -> None:
    transform = SE2(1, 2, 3)
    with pytest.raises(FrozenInstanceError):
        transform.x = 4.0  # type: ignore[misc]
    assert len({transform, SE2(1, 2, 3)}) == 1
    assert pickle.loads(pickle.dumps(transform)) == transform == copy.deepcopy(transform)
