"""What is written in DAIR-V2X-C's format is read back by our reader; frames can be added."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from cobevglue import Boxes
from cobevglue.datasets import DAIRV2X, transform_boxes
from cobevglue.datasets.dair_v2x_writer import (
    DAIRPair,
    DAIRSide,
    dair_v2x_frame_files,
    write_dair_v2x_frame,
    write_dair_v2x_index,
)
from cobevglue.datasets.poses import inverse_SE3
from cobevglue.typing import Float32Array, FloatArray

WORLD = Boxes(
    [[10, 3, 0.8], [40, -0.5, 1.6], [0, -9, 0.7]],
    [[4.6, 2.0, 1.6], [11, 2.6, 3.3], [2.1, 0.8, 1.5]],
    [0.3, -3.0, 1.6],
    label=["suv", "bus", "motorcycle"],
)


def pose(x: float, yaw: float, z: float, lean: float = 0.0) -> FloatArray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("ZY", [yaw, lean]).as_matrix()
    matrix[:3, 3] = x, -20.0, z
    return matrix


CAR, UNIT = pose(5.0, 1.0, 1.9), pose(30.0, -2.5, 5.0)


def cloud(seed: int) -> Float32Array:
    points = np.random.default_rng(seed).uniform(-80, 80, (300, 4)).astype(np.float32)
    points[:, 3] = np.rint(abs(points[:, 3])) * np.float32(1 / 255.0)
    return points


def write(root: Path, *frames: str, car: FloatArray = CAR, with_points: bool = True) -> None:
    for number, frame in enumerate(frames):
        write_dair_v2x_frame(
            root,
            frame,
            DAIRSide(car, transform_boxes(WORLD[:2], inverse_SE3(car)), cloud(number) if with_points else None),
            DAIRSide(UNIT, transform_boxes(WORLD[1:], inverse_SE3(UNIT)), cloud(9) if with_points else None),
            transform_boxes(WORLD, inverse_SE3(car)),
        )


def assert_same(read: Boxes, truth: Boxes) -> None:
    for field in ("center", "size"):
        np.testing.assert_allclose(getattr(read, field), getattr(truth, field), atol=1e-9)
    np.testing.assert_allclose(np.exp(1j * read.yaw), np.exp(1j * truth.yaw), atol=1e-9)


@pytest.mark.parametrize("labels", ["complemented", "original"])
def test_written_files_are_read_back(labels: str, tmp_path: Path) -> None:
    write(tmp_path, "000001", "000002")
    write_dair_v2x_index(tmp_path, "test", [DAIRPair("000001", "b", 0.0), DAIRPair("000002", "b", 0.1)])
    scenario = DAIRV2X(tmp_path, "test", labels=labels)["b"]  # type: ignore[arg-type]
    assert [frame.time for frame in scenario] == pytest.approx([0.0, 0.1])
    car, unit = scenario[1].agents["vehicle"], scenario[1].agents["infrastructure"]
    np.testing.assert_allclose(car.world_SE3_lidar, CAR, atol=1e-12)
    np.testing.assert_allclose(unit.world_SE3_lidar, UNIT, atol=1e-12)
    for points, had in ((car.points, cloud(1)), (unit.points, cloud(9))):
        assert points is not None
        np.testing.assert_array_equal(points[:, :3], had[:, :3])
        np.testing.assert_allclose(points[:, 3], had[:, 3], rtol=1e-6)
    assert_same(car.objects, transform_boxes(WORLD[:2], inverse_SE3(CAR)))
    assert_same(unit.objects, transform_boxes(WORLD[1:2], inverse_SE3(UNIT)))  # the benchmark has no motorcycles
    assert_same(scenario[1].ground_truth("vehicle"), transform_boxes(WORLD[:2], inverse_SE3(CAR)))
    np.testing.assert_array_equal(scenario[1].ground_truth("vehicle").label, ["car", "bus"])


def test_two_wheelers_are_available_by_class(tmp_path: Path) -> None:
    write(tmp_path, "000001")
    write_dair_v2x_index(tmp_path, "test", [DAIRPair("000001", "b", 0.0)])
    frame = DAIRV2X(tmp_path, "test", classes={"motorcyclist"})["b"][0]
    assert len(frame.ground_truth("vehicle")) == len(frame.agents["infrastructure"].objects) == 1


def test_common_labels_of_a_leaning_car(tmp_path: Path) -> None:
    leaning = pose(5.0, 1.0, 1.9, lean=0.02)
    write(tmp_path, "000001", car=leaning)
    write_dair_v2x_index(tmp_path, "test", [DAIRPair("000001", "b", 0.0)])
    assert_same(
        DAIRV2X(tmp_path, "test")["b"][0].ground_truth("vehicle"), transform_boxes(WORLD[:2], inverse_SE3(leaning))
    )


def test_frames_are_added_to_an_existing_tree(tmp_path: Path) -> None:
    write(tmp_path, "000001", "000002", "000003", with_points=False)
    write_dair_v2x_index(tmp_path, "train", [DAIRPair("000001", "a", 0.0)])
    write_dair_v2x_index(tmp_path, "test", [DAIRPair("000002", "b", 0.0)])
    write_dair_v2x_index(tmp_path, "test", [DAIRPair("000002", "b", 0.0), DAIRPair("000003", "c", 0.0)])
    assert DAIRV2X(tmp_path, "train").scenarios == ("a",)
    assert DAIRV2X(tmp_path, "test").scenarios == ("b", "c")
    assert DAIRV2X(tmp_path, "test")["c"][0].agents["vehicle"].points is None


@pytest.mark.parametrize("with_points", [True, False])
def test_only_the_files_of_a_frame_are_written(with_points: bool, tmp_path: Path) -> None:
    write(tmp_path, "000001", with_points=with_points)
    files = dair_v2x_frame_files(tmp_path, "000001", with_points)
    assert sorted(files) == sorted(path for path in tmp_path.rglob("*") if path.is_file())


@pytest.mark.parametrize(("frame", "car", "said"), [("x", CAR, "digits"), ("000001", 2 * CAR, "vehicle-side")])
def test_unsupported_values_are_refused(frame: str, car: FloatArray, said: str, tmp_path: Path) -> None:
    side = DAIRSide(UNIT, Boxes.empty())
    with pytest.raises(ValueError, match=said):
        write_dair_v2x_frame(tmp_path, frame, DAIRSide(car, Boxes.empty()), side, Boxes.empty())


def test_a_broken_index_is_named(tmp_path: Path) -> None:
    (tmp_path / "vehicle-side").mkdir()
    (tmp_path / "vehicle-side" / "data_info.json").write_text("[{}]")
    with pytest.raises(ValueError, match=r"data_info\.json"):
        write_dair_v2x_index(tmp_path, "test", [DAIRPair("000001", "a", 0.0)])
