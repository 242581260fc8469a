"""OpenCOOD's conventions: hand-made boxes and poses, round trips, and a warp of a feature map by the matrices."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cobevglue import SE2, Boxes
from cobevglue.datasets.poses import SE3_from_carla, SE3_from_SE2
from cobevglue.interop import (
    SE3_from_lidar_pose,
    boxes_from_centers,
    boxes_from_corners,
    centers_from_boxes,
    corners_from_boxes,
    lidar_pose_from_SE3,
    normalized_affine,
    pairwise_t_matrix,
)

metres = st.floats(-200.0, 200.0)
side = st.floats(0.1, 20.0)
angle = st.floats(-3.1, 3.1)


@st.composite
def some_boxes(draw: st.DrawFn) -> Boxes:
    rows = draw(st.lists(st.tuples(*[metres] * 3, *[side] * 3, angle), max_size=5))
    table = np.array(rows).reshape(-1, 7)
    return Boxes(table[:, :3], table[:, 3:6], table[:, 6])


poses = st.builds(SE2, metres, metres, angle)

# 1 m to the right of the agent and 10 m ahead, turned 30 degrees to the left: 4 m long, 2 m wide, 1.5 m high.
BOX = Boxes([(10.0, -1.0, 0.5)], [(4.0, 2.0, 1.5)], [math.radians(30.0)])


@pytest.mark.parametrize(
    ("order", "left_handed", "row"),
    [
        ("hwl", True, (10.0, 1.0, 0.5, 1.5, 2.0, 4.0, -math.pi / 6)),
        ("lwh", True, (10.0, 1.0, 0.5, 4.0, 2.0, 1.5, -math.pi / 6)),
        ("hwl", False, (10.0, -1.0, 0.5, 1.5, 2.0, 4.0, math.pi / 6)),
    ],
)
def test_center_rows_in_each_convention(order: str, left_handed: bool, row: tuple[float, ...]) -> None:
    np.testing.assert_allclose(centers_from_boxes(BOX, order=order, left_handed=left_handed), [row])
    back = boxes_from_centers([row], order=order, left_handed=left_handed)
    np.testing.assert_allclose(back.bev, BOX.bev)


def test_corners_in_documented_order() -> None:
    upright = Boxes([(10.0, -1.0, 0.5)], [(4.0, 2.0, 1.0)], [0.0])
    below = [(12, 0, 0), (12, 2, 0), (8, 2, 0), (8, 0, 0)]  # left-handed: y = 1 is the centre, 1 m to the right
    expected = [*below, *[(x, y, 1) for x, y, _ in below]]
    np.testing.assert_allclose(corners_from_boxes(upright)[0], expected)
    mirrored = [(x, -1 + (y - 1), z) for x, y, z in expected]
    np.testing.assert_allclose(corners_from_boxes(upright, left_handed=False)[0], mirrored)


def test_first_corner_turns_with_the_heading() -> None:
    c, s = math.cos(math.pi / 6), math.sin(math.pi / 6)
    # Front left of the box: 2 m ahead and 1 m to the left along its axes; the first corner in left-handed axes.
    x, y = 10.0 + 2 * c - 1 * s, -1.0 + 2 * s + 1 * c
    np.testing.assert_allclose(corners_from_boxes(BOX)[0, 0], (x, -y, -0.25))
    np.testing.assert_allclose(corners_from_boxes(BOX, left_handed=False)[0, 1], (x, y, -0.25))


@given(some_boxes(), st.sampled_from(["hwl", "lwh"]), st.booleans())
def test_box_round_trips_are_exact(boxes: Boxes, order: str, left_handed: bool) -> None:
    rows = centers_from_boxes(boxes, order=order, left_handed=left_handed)
    back = boxes_from_centers(rows, order=order, left_handed=left_handed)
    np.testing.assert_array_equal(np.column_stack([back.center, back.size, back.yaw]), _table(boxes))
    corners = corners_from_boxes(boxes, left_handed=left_handed)
    back = boxes_from_corners(corners, left_handed=left_handed)
    np.testing.assert_allclose(_table(back), _table(boxes), atol=1e-9)


def test_size_of_tilted_corners_is_kept() -> None:
    tilt = SE3_from_carla([0, 0, 0, 5.0, 0.0, 10.0])[:3, :3]
    corners = corners_from_boxes(BOX.replace(yaw=[0.0]), left_handed=False) @ tilt.T
    back = boxes_from_corners(corners, left_handed=False)
    np.testing.assert_allclose(back.size, BOX.size)
    np.testing.assert_allclose(back.center, BOX.center @ tilt.T)


@given(
    st.tuples(*[metres] * 3),
    st.tuples(st.floats(-170, 170), st.floats(-170, 170), st.floats(-80, 80)),
    st.booleans(),
)
def test_lidar_pose_round_trips(position: tuple[float, ...], angles: tuple[float, ...], left_handed: bool) -> None:
    pose = [*position, *angles]
    matrix = SE3_from_lidar_pose(pose, left_handed=left_handed)
    assert np.linalg.det(matrix) == pytest.approx(1.0)
    np.testing.assert_allclose(lidar_pose_from_SE3(matrix, left_handed=left_handed), pose, atol=1e-9)


@pytest.mark.parametrize(("left_handed", "ahead"), [(True, (5, -8)), (False, (5, 8))])
def test_yaw_turns_x_towards_the_given_y(left_handed: bool, ahead: tuple[float, float]) -> None:
    matrix = SE3_from_lidar_pose([5, 7, 2, 0, 90, 0], left_handed=left_handed)
    np.testing.assert_allclose(matrix @ [1, 0, 0, 1], [*ahead, 2, 1])


def test_lidar_pose_may_be_a_matrix() -> None:
    matrix = np.array([[0, -1, 0, 5], [1, 0, 0, 7], [0, 0, 1, 2], [0, 0, 0, 1.0]])  # turned right by 90 degrees
    np.testing.assert_allclose(SE3_from_lidar_pose(matrix), SE3_from_lidar_pose([5, 7, 2, 0, 90, 0]), atol=1e-12)
    np.testing.assert_allclose(SE3_from_lidar_pose(matrix, left_handed=False), matrix)


def test_pairwise_entry_maps_row_to_column() -> None:
    # The other agent is 10 m ahead of the ego and 2 m to its left, looking left.
    pairwise = pairwise_t_matrix([[SE2(), SE2(10.0, 2.0, math.pi / 2)]], 3, left_handed=False)
    assert pairwise.shape == (1, 3, 3, 4, 4)
    # Its own origin, as the ego has it; and the ego's origin: 10 m behind along x is 10 m to its left, 2 m behind it.
    np.testing.assert_allclose(pairwise[0, 1, 0] @ [0, 0, 0, 1], [10, 2, 0, 1], atol=1e-12)
    np.testing.assert_allclose(pairwise[0, 0, 1] @ [0, 0, 0, 1], [-2, 10, 0, 1], atol=1e-12)
    np.testing.assert_array_equal(pairwise[0, 2], np.tile(np.eye(4), (3, 1, 1)))


def test_left_handed_pairwise_mirrors_y() -> None:
    pairwise = pairwise_t_matrix([[SE2(), SE2(10.0, 2.0, math.pi / 2)]], 2)
    np.testing.assert_allclose(pairwise[0, 1, 0] @ [0, 0, 0, 1], [10, -2, 0, 1], atol=1e-12)
    np.testing.assert_allclose(pairwise[0, 0, 1] @ [0, 0, 0, 1], [-2, -10, 0, 1], atol=1e-12)


@given(st.lists(poses, min_size=1, max_size=4))
def test_pairwise_equals_poses_in_the_world(agents: list[SE2]) -> None:
    """As OpenCOOD computes it: inverse(world_T_j) world_T_i from left-handed poses in the world."""
    world_SE3_ego = SE3_from_lidar_pose([30.0, -20.0, 1.0, 0.0, 50.0, 0.0])
    ego_SE2_agents = [SE2(), *agents]
    lidar_poses = [lidar_pose_from_SE3(world_SE3_ego @ SE3_from_SE2(pose)) for pose in ego_SE2_agents]
    pairwise = pairwise_t_matrix([ego_SE2_agents], 5)[0]
    mirror = np.diag([1.0, -1.0, 1.0, 1.0])
    world = [mirror @ SE3_from_carla(pose) @ mirror for pose in lidar_poses]
    for i, world_T_i in enumerate(world):
        for j, world_T_j in enumerate(world):
            np.testing.assert_allclose(pairwise[i, j], np.linalg.solve(world_T_j, world_T_i), atol=1e-9)


def test_spatial_poses_keep_height_and_tilt() -> None:
    tilted = SE3_from_carla([10.0, 2.0, 1.5, 3.0, 40.0, -2.0])
    pairwise = pairwise_t_matrix([[np.eye(4), tilted]], 2, left_handed=False)
    np.testing.assert_allclose(pairwise[0, 1, 0], tilted)


def test_affine_warps_a_blob_to_the_ego() -> None:
    torch = pytest.importorskip("torch")
    height, width, cell = 40, 100, 0.8
    ego_SE2_other = SE2(12.0, -6.0, math.radians(35.0))
    point_in_other = np.array([8.4, 3.6])
    feature = np.zeros((height, width))
    column, row = point_in_other / cell + np.array([width, height]) / 2 - 0.5
    rows, columns = np.mgrid[:height, :width]
    feature[:] = np.exp(-((rows - row) ** 2 + (columns - column) ** 2) / 4.0)
    pairwise = pairwise_t_matrix([[SE2(), ego_SE2_other]], 2, left_handed=False)
    theta = normalized_affine(pairwise, height, width, cell)
    assert theta.shape == (1, 2, 2, 2, 3)
    grid = torch.nn.functional.affine_grid(torch.tensor(theta[0, 0, 1:]), [1, 1, height, width], align_corners=False)
    warped = torch.nn.functional.grid_sample(torch.tensor(feature)[None, None], grid, align_corners=False)[0, 0].numpy()
    seen = np.array([(columns * warped).sum(), (rows * warped).sum()]) / warped.sum()
    np.testing.assert_allclose(
        (seen + 0.5 - np.array([width, height]) / 2) * cell, ego_SE2_other.apply(point_in_other), atol=0.02
    )


def test_nothing_becomes_nothing() -> None:
    assert len(boxes_from_centers([])) == len(boxes_from_corners([])) == 0
    assert pairwise_t_matrix([], 5).shape == (0, 5, 5, 4, 4)
    np.testing.assert_array_equal(pairwise_t_matrix([[]], 1)[0, 0, 0], np.eye(4))


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: boxes_from_centers(np.zeros((2, 6))), r"array must have shape \(N, 7\), got \(2, 6\)"),
        (lambda: boxes_from_centers([(0, 0, 0, 1, 1, 0, 0)]), "size: row 0"),
        (lambda: boxes_from_centers(np.ones((1, 7)), order="wlh"), "order must be one of hwl, lwh, got 'wlh'"),
        (lambda: boxes_from_corners(np.zeros((1, 4, 3))), r"corners must have shape \(N, 8, 3\)"),
        (lambda: pairwise_t_matrix([[SE2(), SE2()]], 1), "sample 0 has 2 agents, max_agents is 1"),
        (lambda: pairwise_t_matrix([[SE2(), None]], 2), "sample 0, agent 1 has no pose: leave the agent out"),
        (lambda: pairwise_t_matrix([[2 * np.eye(4)]], 2), "sample 0, agent 0 is not a rigid transform"),
        (lambda: normalized_affine(np.zeros((3, 3)), 1, 1, 1.0), r"pairwise must have shape \(..., 4, 4\)"),
        (lambda: normalized_affine(np.eye(4), 10, 0, 0.4), "height, width and cell must be > 0"),
        (lambda: SE3_from_lidar_pose([1, 2, 3]), "lidar_pose must be six finite numbers"),
        (lambda: lidar_pose_from_SE3(np.zeros((3, 3))), "world_SE3_lidar must be a finite 4x4 matrix"),
    ],
)
def test_bad_input_is_named(call: Any, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        call()


def _table(boxes: Boxes) -> np.ndarray[Any, np.dtype[np.float64]]:
    return np.column_stack([boxes.center, boxes.size, boxes.yaw])
