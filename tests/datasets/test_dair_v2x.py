"""DAIR-V2X-C in its exact format, with every trap; its files are not held here, so the trees are made by hand."""

from __future__ import annotations

import json
import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from pypcd4.pypcd4 import Encoding, PointCloud
from scipy.spatial.transform import Rotation

from cobevglue import Boxes
from cobevglue.datasets import DAIRV2X, open_dataset, transform_boxes
from cobevglue.datasets.poses import inverse_SE3
from cobevglue.se2 import wrap_angle
from cobevglue.typing import FloatArray

OFFSET = {"delta_x": 1.5, "delta_y": -0.5}
CAR_FRAMES = ("015438", "015439", "015441")
TRUTH = Boxes(
    [[2010, 1030, 21], [2030, 1040, 21.5]], [[4.5, 1.9, 1.6], [10, 2.5, 3]], [0.4, -2.5], label=["car", "bus"]
)


def rigid(yaw: float, xyz: tuple[float, ...], tilt: float = 0.0) -> FloatArray:
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("ZY", [yaw, tilt]).as_matrix()
    matrix[:3, 3] = xyz
    return matrix


WORLD_NOVATEL = rigid(0.7, (2000.0, 1000.0, 20.0), tilt=0.01)
NOVATEL_LIDAR = rigid(-1.6, (0.1, 0.5, 1.3))
WORLD_UNIT_AS_CALIBRATED = rigid(2.2, (2050.0, 1060.0, 22.0))


def world_SE3(agent: str) -> FloatArray:
    """The truth that the reader has to find."""
    if agent == "vehicle":
        return WORLD_NOVATEL @ NOVATEL_LIDAR
    moved = WORLD_UNIT_AS_CALIBRATED.copy()
    moved[:2, 3] += OFFSET["delta_x"], OFFSET["delta_y"]
    return moved


def dump(path: Path, content: Any) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))


def calibration(matrix: FloatArray) -> dict[str, Any]:
    return {"rotation": matrix[:3, :3].tolist(), "translation": matrix[:3, 3:].tolist()}


def own_labels(agent: str, truth: Boxes) -> list[dict[str, Any]]:
    """Labels of one side: its own frame, capital types, numbers as strings, things that are no vehicle or no box."""
    boxes = transform_boxes(truth, inverse_SE3(world_SE3(agent)))
    assert boxes.label is not None
    rows = [
        label(str(kind).capitalize(), center.tolist(), size.tolist(), yaw)
        for center, size, yaw, kind in zip(boxes.center, boxes.size, boxes.yaw, boxes.label, strict=True)
    ]
    rows.append(label("Pedestrian", [1, 2, 0], [0.6, 0.6, 1.7], 0.0))
    rows.append(label("Trafficcone", [1, 3, 0], [0.3, 0.3, 0.7], 0.0))
    rows.append(label("Car", [0, 0, 0], [0, 0, 0], 0.0))  # labelled in the image only
    return rows


def label(kind: str, center: list[float], size: list[float], yaw: float) -> dict[str, Any]:
    return {
        "type": kind,
        "occluded_state": "0",
        "truncated_state": 0,
        "2d_box": {"xmin": 0, "ymin": 0, "xmax": 1, "ymax": 1},
        "3d_dimensions": dict(zip("lwh", map(str, size), strict=True)),
        "3d_location": dict(zip("xyz", map(str, center), strict=True)),
        "rotation": str(float(yaw)),
    }


def common_labels(truth: Boxes) -> list[dict[str, Any]]:
    """Cooperative labels: the world frame, lower-case types, and nothing right but the corners."""
    assert truth.label is not None
    rows = []
    for center, size, yaw, kind in zip(truth.center, truth.size, truth.yaw, truth.label, strict=True):
        around = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) / 2
        corners = np.array([[x, y, z] for z in (-0.5, 0.5) for x, y in around]) * size
        points = corners @ rigid(float(yaw), (0, 0, 0))[:3, :3].T + center
        wrong = label(str(kind), [9.0, 9.0, 9.0], [1.0, 1.0, 1.0], 3.0)
        rows.append(wrong | {"world_8_points": points.tolist()})
    return rows


@pytest.fixture
def root(tmp_path: Path) -> Path:
    """Three pairs with complemented labels in place; the originals know the first object only."""
    base = tmp_path / "cooperative-vehicle-infrastructure"
    car, unit, common = base / "vehicle-side", base / "infrastructure-side", base / "cooperative"
    recordings, pairs = [], []
    for row, frame in enumerate(CAR_FRAMES):
        other = f"{84 + row:06d}"
        dump(car / f"calib/novatel_to_world/{frame}.json", calibration(WORLD_NOVATEL))
        dump(car / f"calib/lidar_to_novatel/{frame}.json", {"transform": calibration(NOVATEL_LIDAR), "frame": "x"})
        dump(
            unit / f"calib/virtuallidar_to_world/{other}.json",
            calibration(WORLD_UNIT_AS_CALIBRATED) | {"relative_error": {"delta_x": "", "delta_y": ""}},
        )
        dump(car / f"label/lidar/{frame}.json", own_labels("vehicle", TRUTH))
        dump(car / f"label/lidar_backup/{frame}.json", own_labels("vehicle", TRUTH[:1]))
        dump(unit / f"label/virtuallidar/{other}.json", own_labels("infrastructure", TRUTH))
        dump(common / f"label_world/{frame}.json", common_labels(TRUTH))
        dump(common / f"label_world_backup/{frame}.json", common_labels(TRUTH[:1]))
        recordings.append(
            {
                "image_path": f"image/{frame}.jpg",
                "pointcloud_path": f"velodyne/{frame}.pcd",
                "pointcloud_timestamp": str(1626247179628753 + 100_000 * (int(frame) - int(CAR_FRAMES[0]))),
                "batch_id": "34",
            }
        )
        pairs.append(
            {
                "infrastructure_image_path": f"infrastructure-side/image/{other}.jpg",
                "infrastructure_pointcloud_path": f"infrastructure-side/velodyne/{other}.pcd",
                "vehicle_image_path": f"vehicle-side/image/{frame}.jpg",
                "vehicle_pointcloud_path": f"vehicle-side/velodyne/{frame}.pcd",
                "cooperative_label_path": f"cooperative/label_world/{frame}.json",
                "system_error_offset": OFFSET,
            }
        )
    dump(car / "data_info.json", recordings)
    dump(common / "data_info.json", pairs[::-1])  # the order of the file is not that of time
    dump(base / "val.json", [*CAR_FRAMES, "999999"])  # one id without a pair
    return base


def edit(path: Path, change: Any) -> None:
    content = json.loads(path.read_text())
    change(content)
    path.write_text(json.dumps(content))


def check_boxes(found: Boxes, expected: Boxes, atol: float = 1e-6) -> None:
    np.testing.assert_allclose(found.center, expected.center, atol=atol)
    np.testing.assert_allclose(found.size, expected.size, atol=atol)
    np.testing.assert_allclose(wrap_angle(found.yaw - expected.yaw), 0.0, atol=1e-4)
    np.testing.assert_array_equal(found.label, expected.label)


@pytest.mark.parametrize("agent", ["vehicle", "infrastructure"])
def test_poses_chain_calibrations_and_pair_offset(root: Path, agent: str) -> None:
    frame = DAIRV2X(root, "val")["34"][0]
    np.testing.assert_allclose(frame.agents[agent].world_SE3_lidar, world_SE3(agent), atol=1e-9)
    assert frame.agents[agent].is_infrastructure == (agent == "infrastructure")


@pytest.mark.parametrize("agent", ["vehicle", "infrastructure"])
def test_own_labels_are_vehicles_in_agent_frame(root: Path, agent: str) -> None:
    objects = DAIRV2X(root, "val")["34"][0].agents[agent].objects
    check_boxes(objects, transform_boxes(TRUTH, inverse_SE3(world_SE3(agent))))
    assert objects.track_id is None  # the data set has no ids


@pytest.mark.parametrize("agent", ["vehicle", "infrastructure"])
def test_common_labels_come_from_the_world_corners_alone(root: Path, agent: str) -> None:
    truth = DAIRV2X(root, "val")["34"][0].ground_truth(agent)
    check_boxes(truth, transform_boxes(TRUTH, inverse_SE3(world_SE3(agent))), atol=0.05)  # the car is tilted


def test_common_and_own_labels_agree_in_the_world(root: Path) -> None:
    frame = DAIRV2X(root, "val")["34"][0]
    for name, agent in frame.agents.items():
        np.testing.assert_allclose(frame.ground_truth(name).center, agent.objects.center, atol=1e-6)


def test_both_sets_of_labels_can_be_had(root: Path) -> None:
    complemented, original = (DAIRV2X(root, "val", labels=labels)["34"][0] for labels in ("complemented", "original"))
    assert len(complemented.ground_truth("vehicle")) == len(complemented.agents["vehicle"].objects) == 2
    assert len(original.ground_truth("vehicle")) == len(original.agents["vehicle"].objects) == 1
    assert len(original.agents["infrastructure"].objects) == 2  # there is one set of these


def test_missing_complemented_labels_raise(root: Path) -> None:
    shutil.rmtree(root / "vehicle-side/label/lidar_backup")
    with pytest.raises(FileNotFoundError, match=r"label_world_backup exists but .*lidar_backup does not"):
        DAIRV2X(root, "val")
    shutil.rmtree(root / "cooperative/label_world_backup")
    with pytest.raises(FileNotFoundError, match=r"original labels.*labels='original'"):
        DAIRV2X(root, "val")
    opened = open_dataset("dair-v2x", root, "val", {"labels": "original"})
    assert len(opened["34"][0].ground_truth("vehicle")) == 2
    with pytest.raises(ValueError, match="no labels 'new'"):
        DAIRV2X(root, "val", labels="new")  # type: ignore[arg-type]


def test_frames_are_in_time_order_with_gaps(root: Path) -> None:
    frames = DAIRV2X(root, "val")["34"]
    assert [frame.timestamp for frame in frames] == list(CAR_FRAMES)
    assert [frame.time for frame in frames] == pytest.approx([0.0, 0.1, 0.3])


def test_batches_are_scenarios_in_numeric_order(root: Path) -> None:
    edit(root / "vehicle-side/data_info.json", lambda rows: rows[0].update(batch_id="9"))
    data = DAIRV2X(root, "val")
    assert data.scenarios == ("9", "34")
    assert [len(scenario) for scenario in data] == [1, 2]


def test_the_folder_above_is_taken_too(root: Path) -> None:
    assert DAIRV2X(root.parent, "val").scenarios == ("34",)


def test_the_official_split_file_is_understood(root: Path, tmp_path: Path) -> None:
    official = {"batch_split": {}, "cooperative_split": {"train": ["015438"], "val": ["015439"], "test_A": []}}
    (root / "val.json").unlink()
    dump(root.parent / "cooperative-split-data.json", official)
    assert [frame.timestamp for frame in DAIRV2X(root, "train")["34"]] == ["015438"]
    with pytest.raises(ValueError, match=r"no split 'tran'; did you mean 'train'\?"):
        DAIRV2X(root, "tran")
    with pytest.raises(ValueError, match="none of the 0 frames of split 'test_A'"):
        DAIRV2X(root, "test_A")
    dump(tmp_path / "mine.json", ["015441"])
    assert [f.timestamp for f in DAIRV2X(root, "mine", split_file=tmp_path / "mine.json")["34"]] == ["015441"]


def test_missing_split_file_error_lists_places(root: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"looked for .*train\.json, .*cooperative-split-data\.json"):
        DAIRV2X(root, "train")


def test_wrong_root_error_names_expected_layout(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"looked for .*cooperative/data_info\.json"):
        DAIRV2X(tmp_path, "val")


def test_an_unknown_batch_names_the_nearest(root: Path) -> None:
    with pytest.raises(ValueError, match="no scenario '35'; did you mean '34'"):
        DAIRV2X(root, "val")["35"]


@pytest.mark.parametrize("encoding", [Encoding.ASCII, Encoding.BINARY, Encoding.BINARY_COMPRESSED])
def test_clouds_are_right_handed_and_may_be_missing(root: Path, encoding: Encoding) -> None:
    points = np.array([[1, 2, 3, 51], [np.nan, 0, 0, 0], [4, -5, 6, 255]], dtype=np.float32)
    (root / "vehicle-side/velodyne").mkdir()
    PointCloud.from_xyzi_points(points).save(root / "vehicle-side/velodyne/015438.pcd", encoding=encoding)
    agents = DAIRV2X(root, "val")["34"][0].agents
    np.testing.assert_allclose(
        np.asarray(agents["vehicle"].points), np.array([[1.0, 2, 3, 0.2], [4, -5, 6, 1]]), rtol=1e-6
    )
    assert agents["infrastructure"].points is None


@pytest.mark.parametrize("nothing", ["", None, {"delta_x": "", "delta_y": ""}])
def test_uncorrected_pair_has_no_offset(root: Path, nothing: Any) -> None:
    edit(root / "cooperative/data_info.json", lambda rows: rows[-1].update(system_error_offset=nothing))
    pose = DAIRV2X(root, "val")["34"][0].agents["infrastructure"].world_SE3_lidar
    np.testing.assert_allclose(pose, WORLD_UNIT_AS_CALIBRATED, atol=1e-9)


def test_an_offset_may_be_a_string(root: Path) -> None:
    edit(root / "cooperative/data_info.json", lambda rows: rows[-1].update(system_error_offset={"delta_x": "2"}))
    pose = DAIRV2X(root, "val")["34"][0].agents["infrastructure"].world_SE3_lidar
    assert pose[0, 3] == pytest.approx(WORLD_UNIT_AS_CALIBRATED[0, 3] + 2)


@pytest.mark.parametrize("kind", ["pedestrian", "Pedestrian"])  # as in the files
def test_other_classes_can_be_asked_for(root: Path, kind: str) -> None:
    objects = DAIRV2X(root, "val", classes=(kind,))["34"][0].agents["vehicle"].objects
    np.testing.assert_array_equal(objects.label, ["pedestrian"])


def test_frame_without_side_labels_has_no_objects(root: Path) -> None:
    dump(root / "vehicle-side/label/lidar/015438.json", [])
    dump(root / "cooperative/label_world/015438.json", [])
    frame = DAIRV2X(root, "val")["34"][0]
    assert len(frame.agents["vehicle"].objects) == len(frame.ground_truth("vehicle")) == 0


def test_frames_can_be_pickled(root: Path) -> None:
    frame = pickle.loads(pickle.dumps(DAIRV2X(root, "val")["34"][0]))
    assert len(frame.ground_truth("vehicle")) == 2


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        (
            "vehicle-side/label/lidar/015438.json",
            lambda c: c[1].update(rotation="north"),
            r"\[1\]\.rotation must be a number",
        ),
        ("vehicle-side/label/lidar/015438.json", lambda c: c[0].pop("3d_location"), r"\[0\]\.3d_location\.x must be a"),
        ("vehicle-side/label/lidar/015438.json", lambda c: c[0]["3d_dimensions"].update(w="-2"), r"\[0\].* negative"),
        ("vehicle-side/label/lidar/015438.json", lambda c: c[0]["3d_location"].update(z="nan"), "must be finite"),
        ("vehicle-side/label/lidar/015438.json", lambda c: c[0].pop("type"), r"\[0\] has no type"),
        ("vehicle-side/label/lidar/015438.json", lambda c: c.append(3), "must be a list of objects"),
        ("vehicle-side/calib/lidar_to_novatel/015438.json", lambda c: c["transform"].pop("rotation"), "no rotation"),
        (
            "vehicle-side/calib/lidar_to_novatel/015438.json",
            lambda c: c.update(transform=[1]),
            "must have rotation and",
        ),
        (
            "vehicle-side/calib/novatel_to_world/015438.json",
            lambda c: c.update(translation=[[1], [2]]),
            "translation must",
        ),
        (
            "vehicle-side/calib/novatel_to_world/015438.json",
            lambda c: c["rotation"][0].__setitem__(0, 7),
            "not a rigid",
        ),
    ],
)
def test_a_broken_file_names_itself_and_the_field(root: Path, file: str, change: Any, message: str) -> None:
    edit(root / file, change)
    with pytest.raises(ValueError, match=message) as error:
        _ = DAIRV2X(root, "val")["34"][0].agents["vehicle"].objects
    assert str(root / file) in str(error.value)


@pytest.mark.parametrize(
    ("file", "change", "message"),
    [
        (
            "cooperative/data_info.json",
            lambda c: c[0].pop("vehicle_pointcloud_path"),
            r"\[0\]\.vehicle_pointcloud_path",
        ),
        (
            "cooperative/data_info.json",
            lambda c: c[0].update(system_error_offset=[1, 2]),
            r"\[0\]\.system_error_offset",
        ),
        ("vehicle-side/data_info.json", lambda c: c[0].pop("pointcloud_timestamp"), r"\[0\]\.pointcloud_timestamp"),
        ("vehicle-side/data_info.json", lambda c: c.pop(), "no entry for 015441"),
        ("val.json", lambda c: c.clear(), "none of the 0 frames"),
    ],
)
def test_a_broken_index_is_noticed_at_once(root: Path, file: str, change: Any, message: str) -> None:
    edit(root / file, change)
    with pytest.raises(ValueError, match=message):
        DAIRV2X(root, "val")


def test_broken_or_missing_files_are_named(root: Path) -> None:
    path = root / "cooperative/label_world/015438.json"
    frame = DAIRV2X(root, "val")["34"][0]
    edit(path, lambda rows: rows[1]["world_8_points"].pop())
    with pytest.raises(ValueError, match=r"015438\.json: \[1\]\.world_8_points must be eight"):
        frame.ground_truth("vehicle")
    path.write_text("[{")
    with pytest.raises(ValueError, match=r"015438\.json: not readable as JSON"):
        frame.ground_truth("vehicle")
    path.unlink()
    with pytest.raises(FileNotFoundError, match=r"label_world/015438\.json does not exist"):
        frame.ground_truth("vehicle")


@pytest.mark.parametrize("where", ["in place", "inside the root", "beside the root"])
@pytest.mark.parametrize("ending", ["pcd", "bin"])
def test_clouds_are_found_where_archives_unpack_them(tmp_path: Path, where: str, ending: str) -> None:
    from cobevglue.datasets.dair_v2x import _cloud_folders, _points
    from cobevglue.datasets.pcd import write_pcd_intensity

    side = tmp_path / "cooperative-vehicle-infrastructure" / "vehicle-side"
    archive = "cooperative-vehicle-infrastructure-vehicle-side-velodyne"
    folders = {"in place": side / "velodyne", "inside the root": side.parent / archive}
    folder = folders.get(where, tmp_path / archive)
    folder.mkdir(parents=True)
    cloud = np.array([[1, 2, 3, 1], [4, 5, 6, 0]], np.float32)
    if ending == "pcd":
        write_pcd_intensity(folder / "000001.pcd", cloud)
    else:
        cloud.tofile(folder / "000001.bin")
    points = _points(_cloud_folders(side), "000001")
    assert points is not None
    np.testing.assert_allclose(points, cloud)
    assert _points(_cloud_folders(side), "000002") is None


def test_the_index_may_name_bin_files(root: Path) -> None:
    """Trees whose clouds were converted to KITTI's format have the new names in their index files, too."""
    for path in (root / "vehicle-side/data_info.json", root / "cooperative/data_info.json"):
        path.write_text(path.read_text().replace(".pcd", ".bin"))
    (root / "vehicle-side/velodyne").mkdir()
    cloud = np.array([[1, 2, 3, 0.5]], dtype=np.float32)
    cloud.tofile(root / "vehicle-side/velodyne/015438.bin")
    points = DAIRV2X(root, "val")["34"][0].agents["vehicle"].points
    assert points is not None
    np.testing.assert_array_equal(points, cloud)


def test_the_layout_of_spd_is_named(root: Path) -> None:
    edit(root / "cooperative/data_info.json", lambda rows: (rows[0].clear(), rows[0].update(vehicle_frame="000001")))
    with pytest.raises(ValueError, match=r"vehicle_frame .* V2X-Seq-SPD; only DAIR-V2X-C is read"):
        DAIRV2X(root, "val")


def test_json_with_a_byte_order_mark_is_read(root: Path) -> None:
    path = root / "vehicle-side/label/lidar/015438.json"
    path.write_bytes(b"\xef\xbb\xbf" + path.read_bytes())
    assert len(DAIRV2X(root, "val")["34"][0].agents["vehicle"].objects) == len(TRUTH)
