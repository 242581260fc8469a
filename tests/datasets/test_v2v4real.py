"""V2V4Real in its exact format, with every trap; its files are not held here, so the trees are made by hand."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from pypcd4.pypcd4 import Encoding, PointCloud

from cobevglue import Boxes
from cobevglue.datasets import V2V4Real, transform_boxes
from cobevglue.datasets.v2v4real import read_v2v4real_labels_yaml
from cobevglue.se2 import wrap_angle
from cobevglue.typing import FloatArray


def pose(x: float, y: float, yaw: float) -> FloatArray:
    """(4, 4) pose of a LiDAR 2 m above the ground."""
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    matrix[:3, 3] = x, y, 2.0
    return matrix


def vehicle(
    x: float, y: float, yaw_degrees: float, ass_id: Any = -1, obj_type: str = "Car", **more: Any
) -> dict[str, Any]:
    """An entry as in the files: in the agent's own LiDAR frame, half extents, angle roll, yaw, pitch in degrees."""
    return {
        "angle": [0.0, yaw_degrees, 0.0],
        "ass_id": ass_id,
        "center": [0.0, 0.0, 0.0],
        "extent": [2.3, 1.0, 0.8],
        "location": [x, y, -1.2],
        "obj_type": obj_type,
        "speed": 0.0,
    } | more


def write_frame(agent_folder: Path, stamp: str, lidar_pose: Any, vehicles: dict[int, Any]) -> Path:
    """As the data set's makers did it: PyYAML's full dumper, numpy arrays and all."""
    agent_folder.mkdir(parents=True, exist_ok=True)
    path = agent_folder / f"{stamp}.yaml"
    document = {"lidar_pose": lidar_pose, "true_ego_pos": lidar_pose, "vehicles": vehicles}
    path.write_text(yaml.dump(document).replace("numpy._core.", "numpy.core."))
    return path


def ids(boxes: Boxes) -> list[int]:
    assert boxes.track_id is not None
    return [int(track_id) for track_id in boxes.track_id]


@pytest.fixture
def scene(tmp_path: Path) -> Path:
    """Two cars 40 m apart facing each other; both see object 5; each sees the other car, and one thing of its own."""
    folder = tmp_path / "test" / "testoutput_CAV_data_2022-03-15-09-54-40_0"
    first = {
        11: vehicle(10.0, 3.0, 90.0, ass_id=5),
        12: vehicle(40.0, 0.0, 180.0, ass_id=6),
        13: vehicle(0.0, -9.0, 0.0),
        14: vehicle(4.0, 6.0, 0.0, obj_type="Pedestrian"),
    }
    second = {
        11: vehicle(30.0, -3.0, -90.0, ass_id=5),
        12: vehicle(40.0, 0.0, 180.0, ass_id=7),
        13: vehicle(5.0, 5.0, 0.0, obj_type="Truck"),
    }
    for number in range(3):
        write_frame(folder / "0", f"{number:06d}", pose(100.0, 50.0, 0.0), first)
        write_frame(folder / "1", f"{number:06d}", pose(140.0, 50.0, np.pi), second)
    return tmp_path


def test_objects_are_in_agent_frame_with_matrix_poses(scene: Path) -> None:
    frame = V2V4Real(scene, "test")["testoutput_CAV_data_2022-03-15-09-54-40_0"][0]
    objects = frame.agents["0"].objects
    np.testing.assert_allclose(objects.center, [[10, 3, -1.2], [40, 0, -1.2], [0, -9, -1.2]])
    np.testing.assert_allclose(np.rad2deg(objects.yaw), [90, 180, 0])
    np.testing.assert_allclose(objects.size, [[4.6, 2.0, 1.6]] * 3)
    np.testing.assert_allclose(frame.agents["1"].world_SE3_lidar, pose(140, 50, np.pi), atol=1e-12)


def test_associated_object_has_one_id_and_place(scene: Path) -> None:
    agents = V2V4Real(scene, "test")["testoutput_CAV_data_2022-03-15-09-54-40_0"][1].agents
    world = {name: transform_boxes(agent.objects, agent.world_SE3_lidar) for name, agent in agents.items()}
    row0, row1 = (ids(world[name]).index(5) for name in "01")
    np.testing.assert_allclose(world["0"].center[row0], world["1"].center[row1], atol=1e-9)
    assert abs(wrap_angle(world["0"].yaw[row0] - world["1"].yaw[row1])) < 1e-9


def test_objects_without_association_get_ids_of_their_own(scene: Path) -> None:
    agents = V2V4Real(scene, "test")["testoutput_CAV_data_2022-03-15-09-54-40_0"][0].agents
    own0, own1 = ids(agents["0"].objects)[2], ids(agents["1"].objects)[2]
    assert own0 != own1  # both are number 13 to their agent
    assert own0 < 0 and own1 < 0  # noqa: PT018
    later = V2V4Real(scene, "test")["testoutput_CAV_data_2022-03-15-09-54-40_0"][2].agents
    assert ids(later["0"].objects)[2] == own0  # the same in every frame


def test_pedestrians_are_skipped_and_types_kept(scene: Path) -> None:
    agents = V2V4Real(scene, "test")["testoutput_CAV_data_2022-03-15-09-54-40_0"][0].agents
    np.testing.assert_array_equal(agents["0"].objects.label, ["car", "car", "car"])
    np.testing.assert_array_equal(agents["1"].objects.label, ["car", "car", "truck"])


def test_ego_is_in_others_ground_truth_only(scene: Path) -> None:
    frame = V2V4Real(scene, "test")["testoutput_CAV_data_2022-03-15-09-54-40_0"][0]
    assert ids(frame.ground_truth("0")) == [
        5,
        6,
        *ids(frame.agents["0"].objects)[2:],
        *ids(frame.agents["1"].objects)[2:],
    ]
    assert 7 in ids(frame.ground_truth("0", include_ego=True))


def test_time_counts_frames(scene: Path) -> None:
    frames = V2V4Real(scene, "test")["testoutput_CAV_data_2022-03-15-09-54-40_0"]
    assert [frame.time for frame in frames] == pytest.approx([0.0, 0.1, 0.2])
    assert [frame.timestamp for frame in frames] == ["000000", "000001", "000002"]


def test_left_handed_reading_mirrors_boxes_pose_and_points(scene: Path) -> None:
    folder = scene / "test" / "testoutput_CAV_data_2022-03-15-09-54-40_0" / "0"
    write_frame(folder, "000000", pose(1.0, 2.0, 0.5), {1: vehicle(10.0, 3.0, 30.0)})
    points = np.array([[1, 2, 3, 51], [4, -5, 6, 255]], dtype=np.float32)
    PointCloud.from_xyzi_points(points).save(folder / "000000.pcd", encoding=Encoding.BINARY)
    name = "testoutput_CAV_data_2022-03-15-09-54-40_0"
    plain = V2V4Real(scene, "test")[name][0].agents["0"]
    turned = V2V4Real(scene, "test", left_handed=True)[name][0].agents["0"]
    np.testing.assert_allclose(np.asarray(plain.points), np.array([[1.0, 2, 3, 0.2], [4, -5, 6, 1]]), rtol=1e-6)
    np.testing.assert_allclose(np.asarray(turned.points), np.array([[1.0, -2, 3, 0.2], [4, 5, 6, 1]]), rtol=1e-6)
    np.testing.assert_allclose(turned.objects.center, plain.objects.center * [1, -1, 1])
    np.testing.assert_allclose(turned.objects.yaw, -plain.objects.yaw)
    np.testing.assert_allclose(turned.world_SE3_lidar, pose(1.0, -2.0, -0.5), atol=1e-12)
    assert np.linalg.det(turned.world_SE3_lidar[:3, :3]) == pytest.approx(1.0)


def test_dumped_arrays_and_numpy_numbers_are_read(tmp_path: Path) -> None:
    entry = vehicle(
        1.0,
        2.0,
        0.0,
        location=np.array([1.0, 2.0, 3.0]),
        ass_id=np.int64(4),
        extent=np.array([2, 1, 1], dtype=np.float32),
    )
    _, objects = read_v2v4real_labels_yaml(write_frame(tmp_path, "000000", pose(0, 0, 0), {1: entry}), agent="0")
    np.testing.assert_allclose(objects.center, [[1, 2, 3]])
    assert ids(objects) == [4]


def test_repeated_association_keeps_own_id(tmp_path: Path) -> None:
    path = write_frame(
        tmp_path, "000000", pose(0, 0, 0), {1: vehicle(1, 2, 0, ass_id=4), 2: vehicle(9, 2, 0, ass_id=4)}
    )
    first, second = ids(read_v2v4real_labels_yaml(path, agent="0")[1])
    assert first == 4
    assert second < 0


@pytest.mark.parametrize(
    ("lidar_pose", "vehicles", "message"),
    [
        ([1.0, 2, 3, 0, 90, 0], {}, "lidar_pose must be a finite 4x4 matrix"),
        (np.diag([1.0, -1, 1, 1]), {}, "lidar_pose is not a proper rotation"),
        (np.full((4, 4), np.nan), {}, "lidar_pose is not finite"),
        (np.eye(4), {3: vehicle(1, 2, 0, extent=[-1, 1, 1])}, r"vehicles\.3\.extent is negative"),
        (np.eye(4), {3: vehicle(1, float("nan"), 0)}, r"vehicles\.3\.location"),
        (np.eye(4), {3: vehicle(1, 2, 0) | {"ass_id": "none"}}, "vehicles: "),
        (np.eye(4), {3: {k: v for k, v in vehicle(1, 2, 0).items() if k != "ass_id"}}, r"vehicles\.3 has no ass_id"),
    ],
)
def test_a_broken_file_names_itself_and_the_field(tmp_path: Path, lidar_pose: Any, vehicles: Any, message: str) -> None:
    path = write_frame(tmp_path, "000000", lidar_pose, vehicles)
    with pytest.raises(ValueError, match=message) as error:
        read_v2v4real_labels_yaml(path, agent="0")
    assert str(path) in str(error.value)


def test_an_agent_folder_of_another_name_is_named(tmp_path: Path) -> None:
    path = write_frame(tmp_path, "000000", np.eye(4), {3: vehicle(1, 2, 0)})
    with pytest.raises(ValueError, match="ego"):
        read_v2v4real_labels_yaml(path, agent="ego")


@pytest.mark.parametrize(("kind", "label"), [("Pedestrian", None), ("Car", "car"), ("TrafficCone", "trafficcone")])
def test_object_type_is_read_as_obj_type(tmp_path: Path, kind: str, label: str | None) -> None:
    """Conversions of RCooper and V2X-Real name the field so; unknown classes keep their name."""
    entry = vehicle(1, 2, 0)
    entry["object_type"] = kind
    del entry["obj_type"]
    _, objects = read_v2v4real_labels_yaml(write_frame(tmp_path, "000000", np.eye(4), {1: entry}), agent="0")
    assert (None if objects.label is None or not len(objects) else objects.label.tolist()) == (label and [label])
