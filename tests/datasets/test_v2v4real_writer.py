"""What is written in V2V4Real's format is read back, by our reader; and what other tools rely on is there."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from scipy.spatial.transform import Rotation

from cobevglue import Boxes
from cobevglue.datasets import V2V4Real, write_v2v4real_frame
from cobevglue.typing import Float32Array, FloatArray

OBJECTS = Boxes(
    [[10, 3, -1.2], [40, -0.5, -1], [0, -9, -0.9]],
    [[4.6, 2.0, 1.6], [11, 2.6, 3.3], [2.1, 0.8, 1.5]],
    [0.3, -3.0, 1.6],
    track_id=[5, 100_007, 0],
    label=["sedan", "bus", "motorcycle"],
)


def pose(yaw: float) -> FloatArray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("ZYX", [yaw, 0.02, -0.01]).as_matrix()
    matrix[:3, 3] = 100.0, -50.0, 2.0
    return matrix


def cloud() -> Float32Array:
    points = np.random.default_rng(0).uniform(-80, 80, (500, 4)).astype(np.float32)
    points[:, 3] = np.rint(abs(points[:, 3])) / np.float32(255.0)
    return points


def written(root: Path, *, left_handed: bool = False) -> Path:
    folder = root / "test" / "drive"
    for agent, yaw in (("0", 0.4), ("1", -2.9)):
        for number in ("000000", "000001"):
            write_v2v4real_frame(folder / agent, number, pose(yaw), OBJECTS, cloud(), left_handed=left_handed)
    return folder


@pytest.mark.parametrize("left_handed", [False, True])
def test_written_files_are_read_back(left_handed: bool, tmp_path: Path) -> None:
    written(tmp_path, left_handed=left_handed)
    scenario = V2V4Real(tmp_path, "test", left_handed=left_handed)["drive"]
    assert [frame.time for frame in scenario] == pytest.approx([0.0, 0.1])
    for agent, yaw in (("0", 0.4), ("1", -2.9)):
        read = scenario[1].agents[agent]
        np.testing.assert_allclose(read.world_SE3_lidar, pose(yaw), atol=1e-12)
        np.testing.assert_array_equal(read.points, cloud())
        assert read.objects.track_id is not None
        order = np.argsort(read.objects.track_id)[[1, 2, 0]]
        for field in ("center", "size", "yaw"):
            np.testing.assert_allclose(getattr(read.objects[order], field), getattr(OBJECTS, field), atol=1e-12)
        np.testing.assert_array_equal(read.objects[order].track_id, OBJECTS.track_id)
        np.testing.assert_array_equal(read.objects[order].label, OBJECTS.label)


def test_pose_is_dumped_as_numpy_1_array(tmp_path: Path) -> None:
    """The data set's own tools take a list for six numbers of a pose."""
    text = (written(tmp_path) / "0" / "000000.yaml").read_text()
    assert "numpy.core.multiarray._reconstruct" in text
    assert "numpy._core" not in text
    assert isinstance(yaml.load(text, Loader=yaml.UnsafeLoader)["lidar_pose"], np.ndarray)


def test_labels_without_a_cloud(tmp_path: Path) -> None:
    write_v2v4real_frame(tmp_path / "test" / "drive" / "0", "000000", pose(0.0), OBJECTS.replace(label=None))
    agent = V2V4Real(tmp_path, "test")["drive"][0].agents["0"]
    assert agent.points is None
    assert set(agent.objects.label.tolist() if agent.objects.label is not None else []) == {"car"}
    assert [file.name for file in (tmp_path / "test" / "drive" / "0").iterdir()] == ["000000.yaml"]


@pytest.mark.parametrize(
    ("agent", "number", "matrix", "objects", "said"),
    [
        ("2", "000000", np.eye(4), OBJECTS, "named 0 and 1"),
        ("0", "first", np.eye(4), OBJECTS, "digits"),
        ("0", "000000", 2 * np.eye(4), OBJECTS, "world_SE3_lidar"),
        ("0", "000000", np.eye(4), OBJECTS.replace(track_id=None), "track_id"),
        ("0", "000000", np.eye(4), OBJECTS.replace(track_id=[-1, 2, 3]), "track_id"),  # -1: not associated
    ],
)
def test_unsupported_values_are_refused(
    agent: str, number: str, matrix: FloatArray, objects: Boxes, said: str, tmp_path: Path
) -> None:
    with pytest.raises(ValueError, match=said):
        write_v2v4real_frame(tmp_path / agent, number, matrix, objects)
    assert not list(tmp_path.rglob("*.yaml"))
