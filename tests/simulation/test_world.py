"""Worlds: what stands where, and that what a LiDAR sees agrees with the truth about it."""

from __future__ import annotations

import numpy as np
import pytest

from cobevglue.datasets.poses import inverse_SE3
from cobevglue.iou import bev_iou
from cobevglue.simulation.episodes import EpisodeSettings, SimulatedEpisodes
from cobevglue.simulation.lidar import LIDARS
from cobevglue.simulation.road_network import NETWORK_KINDS, RoadNetwork
from cobevglue.simulation.scenery import Ground, build_scenery
from cobevglue.simulation.traffic import Traffic, TrafficSnapshot
from cobevglue.simulation.world import LidarView, World, WorldAtTime

LIDAR = LIDARS["opv2v"]


@pytest.fixture(scope="module")
def world() -> World:
    return World("junction_test_0", seed=3)


@pytest.fixture(scope="module")
def snapshot() -> TrafficSnapshot:
    with Traffic("junction_test_0", seed=3) as traffic:
        traffic.step(2.0)
        return traffic.vehicles()


@pytest.fixture(scope="module")
def now(world: World, snapshot: TrafficSnapshot) -> WorldAtTime:
    return world.at(snapshot)


@pytest.fixture(scope="module")
def agents(now: WorldAtTime) -> list[int]:
    """The two vehicles nearest to the middle of the junction that are low enough to carry the sensor."""
    assert now.moving.track_id is not None
    low = np.flatnonzero(now.moving.size[:, 2] < 1.65)
    nearest = low[np.argsort(np.hypot(*now.moving.center[low, :2].T))[:2]]
    ids: list[int] = now.moving.track_id[nearest].tolist()
    return ids


@pytest.fixture(scope="module")
def views(now: WorldAtTime, agents: list[int]) -> list[LidarView]:
    rng = np.random.default_rng(0)
    sensors = [(now.sensor_on_vehicle(agent, LIDAR, rng), agent) for agent in agents]
    return now.views(sensors, [LIDAR, LIDAR])


def test_vehicles_stand_on_the_ground(now: WorldAtTime) -> None:
    foot = now.vehicles.center[:, 2] - now.vehicles.size[:, 2] / 2
    assert foot == pytest.approx(now.world.scenery.ground.height(now.vehicles.center[:, :2]), abs=1e-9)


def test_slope_is_the_derivative_of_height() -> None:
    ground = Ground.random(np.random.default_rng(5))
    at = np.array([[3.0, -20.0], [100.0, 50.0]])
    step = 1e-4
    numeric = np.column_stack([(ground.height(at + e) - ground.height(at - e)) / (2 * step) for e in np.eye(2) * step])
    assert ground.slope(at) == pytest.approx(numeric, abs=1e-6)


@pytest.mark.parametrize("kind", NETWORK_KINDS)
def test_parked_vehicles_are_beside_road_without_overlap(kind: str) -> None:
    roads = RoadNetwork.load(f"{kind}_validation_0")
    parked = World(roads.name, seed=1).parked
    if len(parked):
        assert roads.distance_to_road(parked.center[:, :2]).min() > 0.5
        overlap = bev_iou(parked, parked) - np.eye(len(parked))
        assert overlap.max() < 0.05


def test_half_of_towns_have_no_parked_cars() -> None:
    roads = RoadNetwork.load("town_test_0")
    empty = sum(not build_scenery(roads, np.random.default_rng(seed)).parked for seed in range(12))
    assert 2 <= empty <= 10


def test_highways_have_no_parked_cars() -> None:
    roads = RoadNetwork.load("highway_test_0")
    assert not any(build_scenery(roads, np.random.default_rng(seed)).parked for seed in range(4))


@pytest.mark.parametrize("kind", NETWORK_KINDS)
def test_nothing_solid_stands_on_the_road(kind: str) -> None:
    """No triangle corner between bumper and roof height is more than half a metre inside the road."""
    roads = RoadNetwork.load(f"{kind}_validation_0")
    scenery = build_scenery(roads, np.random.default_rng(2))
    corners = scenery.mesh.triangles.reshape(-1, 3)
    above = corners[:, 2] - scenery.ground.height(corners[:, :2])
    solid = corners[(above > 0.5) & (above < 2.0), :2]
    lanes = [lane for lane in roads.lanes if not lane.internal]
    middle = np.concatenate([lane.centerline for lane in lanes])
    nearest = np.min(np.hypot(*(solid[:, None] - middle[None]).transpose(2, 0, 1)), axis=1)
    assert nearest.min() > 1.0


def test_points_on_objects_lie_in_their_boxes(views: list[LidarView]) -> None:
    """Counting points in boxes, grown by 10 cm for noise and lean, finds all that rays say hit the object."""
    for view in views:
        for row in np.flatnonzero(view.point_count >= 20):
            center, yaw = view.boxes.center[row], view.boxes.yaw[row]
            c, s = np.cos(yaw), np.sin(yaw)
            local = (view.points[:, :3] - center) @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]])
            half = view.boxes.size[row] / 2 + [0.1, 0.1, 0.1 + 0.02 * np.hypot(*center[:2])]
            inside = int((np.abs(local) < half).all(axis=1).sum())
            assert inside >= 0.97 * view.point_count[row]


def test_agents_see_each_other_but_not_themselves(views: list[LidarView], agents: list[int]) -> None:
    for view, own in zip(views, agents, strict=True):
        assert view.boxes.track_id is not None
        assert own not in view.boxes.track_id
        assert (view.point_count > 0).all()


def test_two_agents_agree_on_where_things_are(views: list[LidarView]) -> None:
    first, second = views
    assert first.boxes.track_id is not None
    assert second.boxes.track_id is not None
    common, i, j = np.intersect1d(first.boxes.track_id, second.boxes.track_id, return_indices=True)
    assert len(common) >= 3

    in_world = [
        view.boxes.center[rows] @ view.world_SE3_lidar[:3, :3].T + view.world_SE3_lidar[:3, 3]
        for view, rows in ((first, i), (second, j))
    ]
    assert in_world[0] == pytest.approx(in_world[1], abs=1e-6)


def test_sensor_is_above_roof_behind_middle(now: WorldAtTime, agents: list[int]) -> None:
    pose = now.sensor_on_vehicle(agents[0], LIDAR, np.random.default_rng(0))
    assert now.moving.track_id is not None
    row = int(np.flatnonzero(now.moving.track_id == agents[0])[0])
    offset = inverse_SE3(pose)[:3, :3] @ (now.moving.center[row] - pose[:3, 3])
    assert offset[:2] == pytest.approx([0.5, 0.0], abs=0.05)
    assert pose[:3, :3] @ pose[:3, :3].T == pytest.approx(np.eye(3), abs=1e-12)
    assert -offset[2] + now.moving.size[row, 2] / 2 == pytest.approx(LIDAR.height, abs=0.05)


def test_an_unknown_carrier_is_an_error(now: WorldAtTime) -> None:
    with pytest.raises(ValueError, match="4711"):
        now.sensor_on_vehicle(4711, LIDAR, np.random.default_rng(0))


def test_a_mast_looks_down_on_the_scene(now: WorldAtTime) -> None:
    roadside = LIDARS["roadside"]
    view = now.views([(now.sensor_on_mast(12.0, 12.0, 0.0, roadside), -1)], [roadside])[0]
    assert not view.own.any()
    assert len(view.boxes) >= 3
    near = np.hypot(view.points[:, 0], view.points[:, 1]) < 15.0
    assert np.median(view.points[near, 2]) == pytest.approx(-roadside.height, abs=0.5)


def test_episodes_are_repeatable_and_splits_differ() -> None:
    small = EpisodeSettings(snapshots=1, agents=2)
    first, again, other = (
        SimulatedEpisodes(split, 1, small).episode(0) for split in ("validation", "validation", "test")
    )
    assert len(first) == len(again) == 2
    assert [cloud.points.tobytes() for cloud in first] == [cloud.points.tobytes() for cloud in again]
    assert first[0].points.shape != other[0].points.shape or not np.array_equal(first[0].points, other[0].points)
    for cloud in first:
        assert len(cloud.boxes) == len(cloud.point_count)


@pytest.mark.parametrize(
    ("split", "lidars", "message"), [("tests", {"opv2v": 1.0}, "test"), ("test", {"velodyne": 1.0}, "beams32")]
)
def test_unknown_splits_and_sensors_are_errors(split: str, lidars: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SimulatedEpisodes(split, 0, EpisodeSettings(lidars=lidars))
