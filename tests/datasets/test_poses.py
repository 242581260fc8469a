"""CARLA's left-handed poses against an oracle of elementary rotations, by hand, and on OPV2V's own files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cobevglue import SE2, Boxes
from cobevglue.datasets.poses import (
    SE3_from_carla,
    carla_from_SE3,
    inverse_SE3,
    mirrored,
    rigid_SE3,
    transform_boxes,
    upright_yaw,
)
from cobevglue.datasets.safe_yaml import read_yaml
from cobevglue.se2 import wrap_angle
from cobevglue.typing import FloatArray

ANGLE = st.floats(-179.9, 179.9)
COORDINATE = st.floats(-1e4, 1e4)
POSES = st.tuples(COORDINATE, COORDINATE, COORDINATE, ANGLE, ANGLE, st.floats(-89.0, 89.0)).map(np.array)


def carla_matrix(pose: FloatArray) -> FloatArray:
    """CARLA's own left-handed matrix: yaw turns x to y, pitch lifts the nose, roll lowers the right side."""
    roll, yaw, pitch = pose[3:]
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("ZYX", [yaw, -pitch, -roll], degrees=True).as_matrix()
    matrix[:3, 3] = pose[:3]
    return matrix


@pytest.mark.parametrize(
    ("pose", "body_point", "expected", "why"),
    [
        ((1, 2, 3, 0, 0, 0), (0, 0, 0), (1, -2, 3), "y changes sign, the other coordinates stay"),
        ((0, 0, 0, 0, 90, 0), (1, 0, 0), (0, -1, 0), "yaw 90 turns the nose to the right, which is -y"),
        ((0, 0, 0, 0, 0, 90), (1, 0, 0), (0, 0, 1), "pitch 90 lifts the nose"),
        ((0, 0, 0, 90, 0, 0), (0, -1, 0), (0, 0, -1), "roll 90 lowers the right side"),
    ],
)
def test_a_carla_pose_by_hand(
    pose: tuple[float, ...], body_point: tuple[float, ...], expected: tuple[float, ...], why: str
) -> None:
    matrix = SE3_from_carla(pose)
    np.testing.assert_allclose(matrix[:3, :3] @ body_point + matrix[:3, 3], expected, atol=1e-12, err_msg=why)


@given(POSES)
def test_mirrored_carla_matrix_is_a_proper_rotation(pose: FloatArray) -> None:
    matrix = SE3_from_carla(pose)
    np.testing.assert_allclose(matrix, mirrored(carla_matrix(pose)), atol=1e-9)
    assert np.linalg.det(matrix[:3, :3]) == pytest.approx(1.0)


@given(POSES)
def test_a_pose_survives_there_and_back(pose: FloatArray) -> None:
    np.testing.assert_allclose(SE3_from_carla(carla_from_SE3(SE3_from_carla(pose))), SE3_from_carla(pose), atol=1e-9)


@given(POSES)
def test_the_inverse_undoes_a_pose(pose: FloatArray) -> None:
    matrix = SE3_from_carla(pose)
    np.testing.assert_allclose(inverse_SE3(matrix) @ matrix, np.eye(4), atol=1e-8)


def test_untilted_boxes_move_as_in_the_plane() -> None:
    boxes = Boxes([[1, 2, 3], [-4, 5, 0]], [[4, 2, 1.5]] * 2, [0.3, -2.0], track_id=[7, 9])
    planar = SE2(10.0, -3.0, 2.5)
    matrix = np.eye(4)
    matrix[:2, :2], matrix[:2, 3] = planar.rotation, planar.translation
    moved, expected = transform_boxes(boxes, matrix), boxes.transform(planar)
    np.testing.assert_allclose(moved.center, expected.center)
    np.testing.assert_allclose(wrap_angle(moved.yaw - expected.yaw), 0.0, atol=1e-12)
    np.testing.assert_array_equal(moved.track_id, [7, 9])
    assert upright_yaw(matrix) == pytest.approx(2.5)


@pytest.mark.parametrize(
    ("matrix", "message"),
    [
        (np.eye(3), "shape"),
        (np.diag([1, 1, 1, np.nan]), "finite"),
        (np.diag([1.0, -1.0, 1.0, 1.0]), "determinant"),
        (np.diag([2.0, 2.0, 2.0, 1.0]), "rigid"),
        ("pose", "numbers"),
    ],
)
def test_non_rigid_transform_is_refused(matrix: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        rigid_SE3(matrix)


def test_rounding_in_a_stored_matrix_is_put_right() -> None:
    rounded = np.round(SE3_from_carla([1, 2, 3, 5, 40, -3]), 3)
    rotation = rigid_SE3(rounded)[:3, :3]
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(rotation, rounded[:3, :3], atol=2e-3)


@pytest.mark.parametrize("agent", ["car1", "car3"])
def test_opv2v_lidar_mount_fixes_the_signs(culver_city: Path, agent: str) -> None:
    """A wrong sign of roll or pitch moves the mount by centimetres on the slopes of this scenario."""
    files = sorted((culver_city / "test_culvercity" / "ThreeCars_1" / agent).glob("*.yaml"))[::3]
    documents = [read_yaml(file, ("lidar_pose", "true_ego_pos")) for file in files]
    car = np.array([document["true_ego_pos"] for document in documents])
    lidar = SE3_from_carla([document["lidar_pose"] for document in documents])
    mount = (inverse_SE3(SE3_from_carla(car)) @ lidar)[:, :3, 3]
    np.testing.assert_allclose(mount, np.broadcast_to([-0.5, 0.0, 1.9], mount.shape), atol=2e-4)
    for wrong in ([1, 1, 1, -1, 1, 1], [1, 1, 1, 1, 1, -1]):
        spread = (inverse_SE3(SE3_from_carla(car * wrong)) @ lidar)[:, :3, 3].std(axis=0).max()
        assert spread > 5e-3
