"""OPV2V and V2XSet: small hand-made trees with known truth, the writer against the reader, and the real files."""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from cobevglue import SE2, Boxes
from cobevglue.datasets import OPV2V, V2XSet, transform_boxes, write_opv2v_frame
from cobevglue.datasets.opv2v import read_opv2v_labels
from cobevglue.datasets.poses import SE3_from_carla, inverse_SE3
from cobevglue.se2 import wrap_angle

CAR = {"angle": [0, 0, 0], "center": [0, 0, 0.75], "extent": [2, 1, 0.75], "location": [0, 0, 0], "speed": 0.0}


def write_yaml(path: Path, lidar_pose: Any, vehicles: Any) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    document = {
        "camera0": {"cords": [0, 0]},
        "lidar_pose": lidar_pose,
        "plan_trajectory": [[1, 2]],
        "vehicles": vehicles,
    }
    path.write_text(yaml.safe_dump(document))
    return path


def ids(boxes: Boxes) -> list[int]:
    assert boxes.track_id is not None
    return [int(track_id) for track_id in boxes.track_id]


def labels(boxes: Boxes) -> list[str]:
    assert boxes.label is not None
    return [str(label) for label in boxes.label]


def tree(root: Path, *files: str) -> Path:
    """Frames without objects at these paths: split/scenario/agent/timestamp."""
    for file in files:
        write_yaml(root / f"{file}.yaml", [0.0] * 6, {})
    return root


# ---- one file, by hand ----


@pytest.mark.parametrize(
    ("lidar_pose", "vehicle", "center", "yaw", "why"),
    [
        ([0, 0, 0, 0, 0, 0], {"location": [10, 3, 0]}, (10, -3, 0.75), 0.0, "3 m to the right is y = -3"),
        ([0, 0, 0, 0, 0, 0], {"angle": [0, 90, 0]}, (0, 0, 0.75), -np.pi / 2, "the second angle is yaw, clockwise"),
        ([0, 0, 0, 0, 0, 0], {"angle": [5, 0, 3]}, (0, 0, 0.75), 0.0, "roll and pitch of the object are flattened"),
        ([5, 0, 2, 0, 90, 0], {"location": [5, 10, 0]}, (10, 0, -1.25), np.pi / 2, "seen from a LiDAR that faces y"),
        ([0, 0, 0, 0, 0, 90], {"location": [0, 0, 9.25]}, (10, 0, 0), 0.0, "a LiDAR that looks up sees it ahead"),
        (
            [0, 0, 0, 0, 0, 0],
            {"center": [0.5, 1, 0], "angle": [0, 90, 0]},
            (0.5, -1, 0),
            -np.pi / 2,
            "center is not turned",
        ),
    ],
)
def test_an_object_by_hand(
    tmp_path: Path, lidar_pose: list[float], vehicle: dict[str, Any], center: tuple[float, ...], yaw: float, why: str
) -> None:
    path = write_yaml(tmp_path / "000068.yaml", lidar_pose, {7: CAR | vehicle})
    world_SE3_lidar, objects = read_opv2v_labels(path)
    np.testing.assert_allclose(objects.center, [center], atol=1e-9, err_msg=why)
    if lidar_pose[5] == 0:
        np.testing.assert_allclose(wrap_angle(objects.yaw - yaw), 0.0, atol=2e-3, err_msg=why)
    np.testing.assert_allclose(objects.size, [[4, 2, 1.5]])  # the file has half of it
    assert ids(objects) == [7]
    assert labels(objects) == ["car"]
    assert np.linalg.det(world_SE3_lidar[:3, :3]) == pytest.approx(1.0)


def test_matrix_pose_equals_vector_pose(tmp_path: Path) -> None:
    pose = [10.0, -5.0, 1.9, 1.0, 30.0, -2.0]
    left_handed = SE3_from_carla(pose) * np.outer([1, -1, 1, 1], [1, -1, 1, 1])
    six, _ = read_opv2v_labels(write_yaml(tmp_path / "1.yaml", pose, {}))
    matrix, _ = read_opv2v_labels(write_yaml(tmp_path / "2.yaml", left_handed.tolist(), {}))
    np.testing.assert_allclose(six, matrix, atol=1e-12)


@pytest.mark.parametrize("vehicles", [{}, None])
def test_nothing_in_sight_is_no_error(tmp_path: Path, vehicles: Any) -> None:
    _, objects = read_opv2v_labels(write_yaml(tmp_path / "1.yaml", [0] * 6, vehicles))
    assert len(objects) == 0
    assert objects.track_id is not None


def test_a_simulators_bicycle_without_width_is_left_out(tmp_path: Path) -> None:
    vehicles = {3: CAR | {"extent": [0.8, 0.0, 0.7]}, 4: CAR}
    _, objects = read_opv2v_labels(write_yaml(tmp_path / "1.yaml", [0] * 6, vehicles))
    assert ids(objects) == [4]


def test_object_types_are_kept_where_known(tmp_path: Path) -> None:
    vehicles = {3: CAR | {"obj_type": "Truck"}, 4: CAR}
    _, objects = read_opv2v_labels(write_yaml(tmp_path / "1.yaml", [0] * 6, vehicles))
    assert labels(objects) == ["truck", "car"]


@pytest.mark.parametrize(
    ("lidar_pose", "vehicles", "message"),
    [
        ([0] * 6, {7: CAR | {"extent": [2, -1, 1]}}, r"vehicles\.7\.extent is negative"),
        ([0] * 6, {7: CAR | {"location": [float("nan"), 0, 0]}}, r"vehicles\.7\.location must be three finite"),
        ([0] * 6, {7: CAR | {"location": [0, float("inf"), 0]}}, r"vehicles\.7\.location must be three finite"),
        ([0] * 6, {7: CAR | {"angle": [0, 0]}}, r"vehicles\.7\.angle must be three finite"),
        ([0] * 6, {7: CAR | {"center": "here"}}, r"vehicles\.7\.center must be three numbers"),
        ([0] * 6, {7: {"angle": [0, 0, 0], "extent": [1, 1, 1]}}, r"vehicles\.7 has no location"),
        ([0] * 6, {7: [1, 2]}, r"vehicles\.7 must be a mapping"),
        ([0] * 6, {"car": CAR}, r"vehicles\.car: an object id must be an integer"),
        ([0] * 6, {7: CAR, "7": CAR}, r"vehicles: track_id.* 7"),
        ([0] * 6, [CAR], "vehicles must be a mapping"),
        ([0] * 5, {}, "lidar_pose must be six finite numbers"),
        ([0, 0, 0, 0, 0, float("nan")], {}, "lidar_pose must be six finite numbers"),
        (np.diag([1, 1, 1, 0]).tolist(), {}, "lidar_pose is not a rigid"),
        ("nowhere", {}, "lidar_pose"),
    ],
)
def test_a_broken_file_names_itself_and_the_field(tmp_path: Path, lidar_pose: Any, vehicles: Any, message: str) -> None:
    path = write_yaml(tmp_path / "000068.yaml", lidar_pose, vehicles)
    with pytest.raises(ValueError, match=message) as error:
        read_opv2v_labels(path)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("missing", ["lidar_pose", "vehicles"])
def test_a_file_without_a_key_names_it(tmp_path: Path, missing: str) -> None:
    path = tmp_path / "000068.yaml"
    path.write_text(yaml.safe_dump({key: [] for key in ("lidar_pose", "vehicles", "ego_speed") if key != missing}))
    with pytest.raises(ValueError, match=f"no {missing}"):
        read_opv2v_labels(path)


# ---- the tree ----


def test_scenarios_agents_and_frames_are_found_in_order(tmp_path: Path) -> None:
    tree(tmp_path, "test/b/650/000070", "test/b/641/000068", "test/b/641/000070", "test/a/1/000000")
    (tmp_path / "test" / "b" / "data_protocol.yaml").write_text("x: 1")
    (tmp_path / "test" / "b" / "641" / "additional.yaml").write_text("x: 1")  # not a frame
    (tmp_path / "test" / "b" / "641" / "000068_camera0.png").write_text("")
    data = OPV2V(tmp_path, split="test")
    assert data.scenarios == ("a", "b")
    assert [scenario.name for scenario in data] == ["a", "b"]
    assert len(data) == 2
    frames = list(data["b"])
    assert [frame.timestamp for frame in frames] == ["000068", "000070"]
    assert [list(frame.agents) for frame in frames] == [["641"], ["641", "650"]]  # an agent may come late
    assert frames[0].scenario == "b"
    assert frames[0].agents["641"].points is None  # there is no cloud


def test_v2xset_roadside_units_come_last(tmp_path: Path) -> None:
    tree(tmp_path, "test/a/-1/000000", "test/a/641/000000", "test/a/-2/000000", "test/a/1000/000000")
    agents = V2XSet(tmp_path, "test")["a"][0].agents
    assert list(agents) == ["1000", "641", "-1", "-2"]
    assert [agent.is_infrastructure for agent in agents.values()] == [False, False, True, True]


@pytest.mark.parametrize(
    ("numbers", "times", "why"),
    [
        ([68, 70, 72], [0.0, 0.1, 0.2], "OPV2V counts ticks of 0.05 s and keeps every second"),
        ([68, 70, 76, 78], [0.0, 0.1, 0.4, 0.5], "a gap in the numbers is a gap in time"),
        ([0, 1, 2], [0.0, 0.1, 0.2], "numbers may also count frames"),
        ([5], [0.0], "a single frame"),
        ([998, 1000], [0.0, 0.1], "numbers are compared as numbers even without leading zeros"),
    ],
)
def test_time_follows_the_file_numbers(tmp_path: Path, numbers: list[int], times: list[float], why: str) -> None:
    tree(tmp_path, *(f"test/a/1/{number}" for number in numbers))
    assert [frame.time for frame in OPV2V(tmp_path, "test")["a"]] == pytest.approx(times), why


def test_a_scenario_is_a_sequence(tmp_path: Path) -> None:
    tree(tmp_path, "test/a/1/000000", "test/a/1/000002", "test/a/1/000004")
    scenario = OPV2V(tmp_path, "test")["a"]
    assert len(scenario) == 3
    assert scenario[-1].timestamp == "000004"
    assert [frame.timestamp for frame in scenario[1:]] == ["000002", "000004"]
    assert [frame.timestamp for frame in reversed(scenario)] == ["000004", "000002", "000000"]
    with pytest.raises(IndexError, match="scenario a has 3 frames, no frame 3"):
        scenario[3]


def test_files_are_read_lazily_and_once(tmp_path: Path) -> None:
    folder = tree(tmp_path, "test/a/1/000000") / "test" / "a" / "1"
    (folder / "000000.pcd").write_text("broken")
    (folder / "000000.yaml").write_text("lidar_pose: [")
    agent = OPV2V(tmp_path, "test")["a"][0].agents["1"]
    with pytest.raises(ValueError, match=r"000000\.yaml"):
        _ = agent.objects
    write_yaml(folder / "000000.yaml", [0] * 6, {1: CAR})
    assert len(agent.objects) == 1  # without touching the broken cloud
    (folder / "000000.yaml").unlink()
    assert agent.world_SE3_lidar.shape == (4, 4)
    with pytest.raises(ValueError, match=r"000000\.pcd"):
        _ = agent.points


def test_a_file_that_vanishes_is_named(tmp_path: Path) -> None:
    tree(tmp_path, "test/a/1/000000")
    frame = OPV2V(tmp_path, "test")["a"][0]
    (tmp_path / "test/a/1/000000.yaml").unlink()
    with pytest.raises(FileNotFoundError, match=r"000000\.yaml"):
        _ = frame.agents["1"].objects


def test_frames_can_be_pickled(tmp_path: Path) -> None:
    tree(tmp_path, "test/a/1/000000")
    frame = pickle.loads(pickle.dumps(OPV2V(tmp_path, "test")["a"][0]))
    assert len(frame.agents["1"].objects) == 0


def test_an_own_split_name_is_taken(tmp_path: Path) -> None:
    assert OPV2V(tree(tmp_path, "junction/a/1/000000"), "junction").scenarios == ("a",)


@pytest.mark.parametrize(
    ("split", "error", "message"),
    [
        ("test_culvercty", ValueError, r"no split 'test_culvercty'; did you mean 'test_culvercity'\?"),
        ("vaildate", ValueError, "did you mean 'validate'"),
        ("", ValueError, "no split ''"),
        ("train", FileNotFoundError, r"looked for .*train/<scenario>/<agent>/<timestamp>\.yaml.* holds test"),
    ],
)
def test_a_split_that_is_not_there(tmp_path: Path, split: str, error: type[Exception], message: str) -> None:
    tree(tmp_path, "test/a/1/000000")
    with pytest.raises(error, match=message):
        OPV2V(tmp_path, split)


def test_missing_scenario_error_names_nearest(tmp_path: Path) -> None:
    data = OPV2V(tree(tmp_path, "test/TwoCars_1/1/000000", "test/ThreeCars_1/1/000000"), "test")
    with pytest.raises(ValueError, match=r"no scenario 'TwoCars1'; did you mean 'TwoCars_1'\?"):
        data["TwoCars1"]


def test_wrong_root_error_names_expected_layout(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"no folder .*nowhere"):
        OPV2V(tmp_path / "nowhere", "test")
    (tmp_path / "test").mkdir()
    with pytest.raises(FileNotFoundError, match="holds no <scenario>/<agent>/<timestamp>"):
        OPV2V(tmp_path, "test")
    (tmp_path / "test" / "a" / "1").mkdir(parents=True)
    with pytest.raises(FileNotFoundError, match=r"test/a holds no <agent>/<timestamp>\.yaml"):
        OPV2V(tmp_path, "test")["a"]


# ---- the writer ----

ANGLE = st.floats(-3.1, 3.1)
COORDINATE = st.floats(-500, 500)
SIZE = st.floats(0.1, 20)
OBJECTS = st.lists(
    st.tuples(st.tuples(*[COORDINATE] * 3), st.tuples(*[SIZE] * 3), ANGLE, st.integers(0, 10**6)),
    max_size=6,
    unique_by=lambda row: row[3],
)
POSE = st.tuples(*[COORDINATE] * 3, st.floats(-10, 10), st.floats(-180, 180), st.floats(-10, 10))


@settings(max_examples=40, deadline=None)
@given(OBJECTS, POSE)
def test_written_frames_are_read_again(
    tmp_path_factory: pytest.TempPathFactory, rows: list[Any], pose: tuple[float, ...]
) -> None:
    centers, sizes, yaws, numbers = zip(*rows, strict=True) if rows else ([], [], [], [])
    objects = Boxes(centers, sizes, yaws, track_id=numbers, label=["van"] * len(rows))
    world_SE3_lidar = SE3_from_carla(pose)
    root = tmp_path_factory.mktemp("opv2v")
    points = np.array([[1.5, -2.25, 0.5, 51 / 255]], dtype=np.float32)
    write_opv2v_frame(root / "test" / "a" / "1", "000068", world_SE3_lidar, objects, points)
    agent = OPV2V(root, "test")["a"][0].agents["1"]
    np.testing.assert_allclose(agent.world_SE3_lidar, world_SE3_lidar, atol=1e-9)
    order = np.argsort(ids(objects))
    read = agent.objects[np.argsort(ids(agent.objects))]
    np.testing.assert_allclose(read.center, objects.center[order], atol=1e-9)
    np.testing.assert_allclose(read.size, objects.size[order], rtol=1e-12)
    np.testing.assert_allclose(wrap_angle(read.yaw - objects.yaw[order]), 0.0, atol=1e-9)
    assert set(labels(read)) <= {"van"}
    np.testing.assert_array_equal(agent.points, points)


def test_file_is_left_handed_and_in_degrees(tmp_path: Path) -> None:
    objects = Boxes([[10, 3, -1]], [[4, 2, 1.5]], [np.pi / 2], track_id=[7])
    write_opv2v_frame(tmp_path, "000068", SE3_from_carla([0, 0, 1.9, 0, 0, 0]), objects, speeds={7: 36.0})
    document = yaml.safe_load((tmp_path / "000068.yaml").read_text())
    assert document["lidar_pose"] == pytest.approx([0, 0, 1.9, 0, 0, 0])
    vehicle = document["vehicles"][7]
    assert vehicle["angle"] == pytest.approx([0, -90, 0])
    assert vehicle["location"] == pytest.approx([10, -3, 0.15])  # on the ground
    assert vehicle["center"] == pytest.approx([0, 0, 0.75])
    assert vehicle["extent"] == pytest.approx([2, 1, 0.75])
    assert vehicle["speed"] == 36.0
    assert not (tmp_path / "000068.pcd").exists()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"timestamp": "first"}, "timestamp must be digits"),
        ({"objects": Boxes([[0, 0, 0]], [[4, 2, 1]], [0])}, "objects must have a track_id"),
        ({"world_SE3_lidar": np.zeros((4, 4))}, "world_SE3_lidar is not a rigid"),
        ({"world_SE3_vehicle": np.eye(3)}, "world_SE3_vehicle must be"),
        ({"points": np.zeros((1, 3))}, "points must have shape"),
    ],
)
def test_writer_refuses_unsupported_values(tmp_path: Path, arguments: dict[str, Any], message: str) -> None:
    objects = Boxes([[0, 0, 0]], [[4, 2, 1]], [0], track_id=[1])
    good: dict[str, Any] = {"timestamp": "000068", "world_SE3_lidar": np.eye(4), "objects": objects}
    with pytest.raises(ValueError, match=message):
        write_opv2v_frame(tmp_path, **(good | arguments))


# ---- the truth of a whole frame ----


def test_ground_truth_is_union_without_ego(tmp_path: Path) -> None:
    folder = tmp_path / "test" / "a"
    shared = {1: CAR | {"location": [10, 0, 0]}}
    write_yaml(folder / "1" / "0.yaml", [0, 0, 2, 0, 0, 0], {**shared, 20: CAR | {"location": [50, 0, 0]}})
    write_yaml(
        folder / "2" / "0.yaml",
        [50, 0, 2, 0, 180, 0],
        {**shared, 3: CAR | {"location": [40, 8, 0]}, 10: CAR | {"location": [0.4, 0, 0]}},
    )
    frame = OPV2V(tmp_path, "test")["a"][0]
    truth = frame.ground_truth("1")
    assert ids(truth) == [1, 20, 3]
    np.testing.assert_allclose(truth.center, [[10, 0, -1.25], [50, 0, -1.25], [40, -8, -1.25]], atol=1e-9)
    with_ego = frame.ground_truth("1", include_ego=True)
    assert ids(with_ego) == [1, 20, 3, 10]
    other = frame.ground_truth("2")
    assert set(ids(other)) == {1, 3, 10}
    with pytest.raises(ValueError, match="no agent '3'"):
        frame.ground_truth("3")


# ---- real files ----


def test_the_real_scenarios(culver_city: Path) -> None:
    data = OPV2V(culver_city, "test_culvercity")
    assert {scenario.name: len(scenario) for scenario in data} == {"TwoCars_1": 90, "ThreeCars_1": 135}
    frames = data["TwoCars_1"][:4]
    assert [frame.time for frame in frames] == pytest.approx([0.0, 0.1, 0.2, 0.3])
    assert frames[0].agents["car1"].points is None
    assert frames[1].agents["car1"].points is not None


@pytest.mark.parametrize("name", ["TwoCars_1", "ThreeCars_1"])
def test_shared_objects_coincide_in_the_world(culver_city: Path, name: str) -> None:
    compared = 0
    for frame in OPV2V(culver_city, "test_culvercity")[name][::9]:
        seen: dict[int, tuple[Any, float]] = {}
        for agent in frame.agents.values():
            objects = transform_boxes(agent.objects, agent.world_SE3_lidar)
            for row, track_id in enumerate(ids(objects)):
                center, yaw = seen.setdefault(track_id, (objects.center[row], float(objects.yaw[row])))
                np.testing.assert_allclose(objects.center[row], center, atol=1e-6)
                assert abs(wrap_angle(objects.yaw[row] - yaw)) < 2e-3  # flattening tilts by second order only
                compared += 1
    assert compared > 200


def test_other_car_box_is_at_its_pose(culver_city: Path) -> None:
    """Another agent's label of a car against that car's own LiDAR pose, half a metre behind its middle."""
    for frame in OPV2V(culver_city, "test_culvercity")["TwoCars_1"][::10]:
        car1, car2 = frame.agents["car1"], frame.agents["car2"]
        whole, without = (frame.ground_truth("car1", include_ego=include) for include in (True, False))
        assert len(whole) - len(without) <= 1
        where = (inverse_SE3(car1.world_SE3_lidar) @ car2.world_SE3_lidar)[:, 3]
        distance = np.hypot(*(car1.objects.center[:, :2] - where[:2]).T)
        if distance.min() < 2.0:  # it is in sight
            heading = SE2.from_matrix(inverse_SE3(car1.world_SE3_lidar) @ car2.world_SE3_lidar).yaw
            row = int(distance.argmin())
            assert distance[row] == pytest.approx(0.5, abs=0.05)
            assert abs(wrap_angle(car1.objects.yaw[row] - heading)) < 1e-3


def test_boxes_hold_points_unless_mirrored(culver_city: Path) -> None:
    inside, mirrored_inside, near_objects = 0, 0, 0
    for frame in OPV2V(culver_city, "test_culvercity")["TwoCars_1"][1:14:6]:
        for agent in frame.agents.values():
            points = agent.points
            assert points is not None
            near = agent.objects[np.hypot(*agent.objects.center[:, :2].T) < 40.0]
            near_objects += len(near)
            inside += int((_points_inside(near, points) > 0).sum())
            mirrored_inside += int((_points_inside(near, points * [1, -1, 1, 1]) > 4).sum())
    assert near_objects > 40
    assert inside == near_objects
    assert mirrored_inside < 0.8 * near_objects


def _points_inside(boxes: Boxes, points: Any) -> Any:
    counts = []
    for center, size, yaw in zip(boxes.center, boxes.size, boxes.yaw, strict=True):
        moved = SE2(center[0], center[1], float(yaw)).inverse().apply(points[:, :3]) - [0, 0, center[2]]
        counts.append((np.abs(moved) < size / 2 + 0.05).all(axis=1).sum())
    return np.array(counts)


def test_a_real_frame_survives_writing_and_reading(culver_city: Path, tmp_path: Path) -> None:
    agent = OPV2V(culver_city, "test_culvercity")["TwoCars_1"][1].agents["car1"]
    write_opv2v_frame(tmp_path / "s" / "a" / "1", "006222", agent.world_SE3_lidar, agent.objects, agent.points)
    again = OPV2V(tmp_path, "s")["a"][0].agents["1"]
    np.testing.assert_allclose(again.world_SE3_lidar, agent.world_SE3_lidar, atol=1e-12)
    np.testing.assert_allclose(again.objects.center, agent.objects.center, atol=1e-9)
    np.testing.assert_array_equal(again.points, agent.points)
