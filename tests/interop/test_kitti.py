"""KITTI label files: a hand-made line, round trips, the reader of tracking files as an oracle, bad files."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cobevglue import Boxes
from cobevglue.datasets.poses import inverse_SE3
from cobevglue.datasets.tracking_text import read_kitti_labels
from cobevglue.interop import (
    boxes_from_kitti,
    kitti_from_boxes,
    read_kitti_calibration,
    read_kitti_objects,
    write_kitti_objects,
)

# 20 m ahead of the camera, 3 m to its right, on a ground 1.7 m below it, driving away from it.
LINE = "Car 0.00 0 -1.5 0 0 10 10 1.5 1.8 4.2 3.0 1.7 20.0 -1.5707963267948966"
LEVEL = np.array([[0, -1, 0, 0], [0, 0, -1, -0.08], [1, 0, 0, -0.27], [0, 0, 0, 1.0]])
"""A camera 0.27 m ahead of the LiDAR and 0.08 m below it, level with it."""


def tilted() -> Any:
    matrix = LEVEL.copy()
    matrix[:3, :3] = Rotation.from_euler("xyz", [0.6, -0.4, 0.5], degrees=True).as_matrix() @ LEVEL[:3, :3]
    return matrix


def write(path: Path, *lines: str) -> Path:
    path.write_text("\n".join(lines) + "\n")
    return path


def test_line_in_the_frame_at_the_camera(tmp_path: Path) -> None:
    boxes = read_kitti_objects(write(tmp_path / "a.txt", LINE))
    np.testing.assert_allclose(boxes.center, [[20.0, -3.0, -1.7 + 0.75]])
    np.testing.assert_allclose(boxes.size, [[4.2, 1.8, 1.5]])
    np.testing.assert_allclose(boxes.yaw, [0.0], atol=1e-12)
    assert boxes.label is not None
    assert boxes.label.tolist() == ["car"]
    assert boxes.score is None


def test_line_in_the_lidar_frame() -> None:
    boxes = boxes_from_kitti([(1.5, 1.8, 4.2, 3.0, 1.7, 20.0, -math.pi / 2)], LEVEL)
    np.testing.assert_allclose(boxes.center, [[20.27, -3.0, -1.7 + 0.75 - 0.08]])
    np.testing.assert_allclose(boxes.yaw, [0.0], atol=1e-12)


@given(
    st.lists(st.tuples(*[st.floats(0.1, 20)] * 3, *[st.floats(-80, 80)] * 3, st.floats(-3.1, 3.1)), max_size=4),
    st.sampled_from([None, LEVEL]),
)
def test_round_trip_is_exact_where_level(rows: list[Any], calibration: Any) -> None:
    table = np.array(rows).reshape(-1, 7)
    back = kitti_from_boxes(boxes_from_kitti(table, calibration), calibration)
    np.testing.assert_allclose(back, table, atol=1e-9)


def test_tilt_of_the_calibration_costs_little() -> None:
    table = np.array([(1.5, 1.8, 4.2, 3.0, 1.7, 20.0, angle) for angle in np.linspace(-3, 3, 50)])
    back = kitti_from_boxes(boxes_from_kitti(table, tilted()), tilted())
    np.testing.assert_allclose(back[:, :6], table[:, :6], atol=1e-9)
    np.testing.assert_allclose(back[:, 6], table[:, 6], atol=2e-4)


def test_lidar_frame_matches_the_calibration() -> None:
    box = boxes_from_kitti([(1.5, 1.8, 4.2, 3.0, 1.7, 20.0, 0.3)], tilted())
    center_in_camera = [3.0, 1.7 - 0.75, 20.0, 1.0]
    np.testing.assert_allclose(box.center[0], (inverse_SE3(tilted()) @ center_in_camera)[:3])


def test_same_boxes_as_from_a_tracking_file(tmp_path: Path) -> None:
    tracking = read_kitti_labels(write(tmp_path / "t.txt", f"0 5 {LINE}"))[0]
    np.testing.assert_array_equal(read_kitti_objects(write(tmp_path / "o.txt", LINE)).bev, tracking.bev)


def test_files_round_trip(tmp_path: Path) -> None:
    boxes = Boxes(
        [(20.0, -3.0, -0.9), (7.0, 2.0, -0.8)], [(4.2, 1.8, 1.5), (0.6, 0.5, 1.7)], [0.4, -2.0],
        score=[0.9, 0.25], label=["car", "pedestrian"],
    )  # fmt: skip
    write_kitti_objects(tmp_path / "a.txt", boxes, LEVEL)
    back = read_kitti_objects(tmp_path / "a.txt", LEVEL)
    np.testing.assert_allclose(back.center, boxes.center, atol=1e-12)
    np.testing.assert_allclose(back.bev, boxes.bev, atol=1e-12)
    assert back.score is not None
    assert back.label is not None
    assert (back.score.tolist(), back.label.tolist()) == ([0.9, 0.25], ["car", "pedestrian"])
    only = read_kitti_objects(tmp_path / "a.txt", classes=["Pedestrian"])
    assert len(only) == 1


def test_regions_without_a_box_are_omitted(tmp_path: Path) -> None:
    dont_care = "DontCare -1 -1 -10 503 169 590 190 -1 -1 -1 -1000 -1000 -1000 -10"
    assert len(read_kitti_objects(write(tmp_path / "a.txt", dont_care, LINE, ""))) == 1


@pytest.mark.parametrize("names", [("R0_rect:", "Tr_velo_to_cam:"), ("R_rect", "Tr_velo_cam")])
def test_calibration_of_either_benchmark(tmp_path: Path, names: tuple[str, str]) -> None:
    rectification = Rotation.from_euler("x", 0.5, degrees=True).as_matrix()
    lines = [
        "P2: 1 2 3",
        *(
            f"{n} {' '.join(map(repr, m.ravel().tolist()))}"
            for n, m in zip(names, (rectification, LEVEL[:3]), strict=True)
        ),
    ]
    expected = np.eye(4)
    expected[:3, :3] = rectification
    np.testing.assert_allclose(read_kitti_calibration(write(tmp_path / "c.txt", *lines)), expected @ LEVEL, atol=1e-12)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["Car 0 0 0"], "a.txt:1: expected 15 or 16 values, got 4"),
        ([LINE, LINE.replace("20.0", "far")], "a.txt:2: could not convert string to float: 'far'"),
        ([LINE, LINE.replace("1.8", "-1")], "a.txt:2: size: row 0"),
    ],
)
def test_bad_line_is_named(tmp_path: Path, lines: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_kitti_objects(write(tmp_path / "a.txt", *lines))


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["R0_rect: 1 0 0 0 1 0 0 0 1"], "c.txt: Tr_velo_to_cam is missing"),
        (["R0_rect: 1 0 0"], "c.txt: R0_rect must be 9 numbers"),
        (["R0_rect: 2 0 0 0 2 0 0 0 2", f"Tr_velo_cam {'1 ' * 12}"], "c.txt: R0_rect @ Tr_velo_to_cam is not a rigid"),
    ],
)
def test_bad_calibration_is_named(tmp_path: Path, lines: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        read_kitti_calibration(write(tmp_path / "c.txt", *lines))


def test_absent_files_are_named(tmp_path: Path) -> None:
    for reader in (read_kitti_objects, read_kitti_calibration):
        with pytest.raises(FileNotFoundError, match=r"absent\.txt does not exist"):
            reader(tmp_path / "absent.txt")


def test_shape_and_label_are_checked(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"rows must have shape \(N, 7\), got \(1, 6\)"):
        boxes_from_kitti([(1, 2, 3, 4, 5, 6)])
    with pytest.raises(ValueError, match="label: row 0 must be one word, got 'Big car'"):
        write_kitti_objects(tmp_path / "a.txt", Boxes([(1, 2, 3)], [(1, 1, 1)], [0], label=["big car"]))
