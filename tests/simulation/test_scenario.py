"""Simulated scenarios: deterministic for a seed, with consistent views of several agents."""

from __future__ import annotations

import pickle
from collections.abc import Sequence

import numpy as np
import pytest

from cobevglue.boxes import Boxes
from cobevglue.datasets.poses import transform_boxes
from cobevglue.se2 import wrap_angle
from cobevglue.simulation.road_network import NETWORKS
from cobevglue.simulation.scenario import (
    ScenarioSettings,
    SimulatedScenario,
    _choose_agents,
    simulated_scenario,
    simulated_scenarios,
    split_of,
)
from cobevglue.simulation.traffic import TrafficSettings, TrafficSnapshot
from cobevglue.simulation.world import LidarView
from cobevglue.typing import FloatArray, IntArray

pytest.importorskip("libsumo", reason="simulated traffic needs libsumo")
pytest.importorskip("embreex", reason="simulated clouds need embreex")

NETWORK = "t_junction_test_1"
SETTINGS = ScenarioSettings(frames=3, agents=2, roadside_units=1, traffic=TrafficSettings(warm_up=5.0))


@pytest.fixture(scope="module")
def scenario() -> SimulatedScenario:
    """Two cars and a roadside unit, three frames."""
    return SimulatedScenario(NETWORK, 4, SETTINGS)


@pytest.fixture(scope="module")
def views(scenario: SimulatedScenario) -> list[dict[str, LidarView]]:
    return [scenario.views(index) for index in range(len(scenario))]


def ids(boxes: Boxes) -> IntArray:
    assert boxes.track_id is not None
    return boxes.track_id


def content(views: dict[str, LidarView]) -> list[bytes]:
    return [
        part.tobytes()
        for view in views.values()
        for part in (view.points, view.boxes.center, ids(view.boxes), view.point_count, view.world_SE3_lidar)
    ]


def test_seed_decides_frames_in_any_order(scenario: SimulatedScenario, views: list[dict[str, LidarView]]) -> None:
    again = pickle.loads(pickle.dumps(scenario))  # as another process has it, with nothing computed
    assert "traffic" not in vars(again)
    assert content(again.views(2)) == content(views[2])
    assert content(again.views(-1)) == content(views[2])
    assert content(views[1]) != content(views[2])


def test_agents_are_present_and_near_each_other(scenario: SimulatedScenario, views: list[dict[str, LidarView]]) -> None:
    assert [list(seen) for seen in views] == [["car1", "car2", "-1"]] * 3
    places = [views[1][agent].world_SE3_lidar[:2, 3] for agent in ("car1", "car2")]
    assert 4.0 < np.hypot(*(places[0] - places[1])) < SETTINGS.max_distance
    first, second, unit = scenario.carriers.values()
    assert str(first) < str(second), "files named by id are in the order of the names"
    assert unit == -1


def test_shared_objects_coincide_in_the_world(views: list[dict[str, LidarView]]) -> None:
    for seen in views:
        world = {agent: transform_boxes(view.boxes, view.world_SE3_lidar) for agent, view in seen.items()}
        for one, other in (("car1", "car2"), ("car1", "-1"), ("car2", "-1")):
            both, a, b = np.intersect1d(ids(world[one]), ids(world[other]), return_indices=True)
            assert len(both) >= 3
            np.testing.assert_allclose(world[one].center[a], world[other].center[b], atol=1e-3)
            np.testing.assert_allclose(wrap_angle(world[one].yaw[a] - world[other].yaw[b]), 0.0, atol=1e-3)
            np.testing.assert_array_equal(world[one].size[a], world[other].size[b])


def test_points_lie_in_the_boxes_of_their_objects(views: list[dict[str, LidarView]]) -> None:
    for view in views[0].values():
        inside = points_inside(view, margin=0.25)
        assert (view.point_count >= 1).all()
        assert (inside >= view.point_count).all()
        assert (points_inside(view, margin=-0.5) < view.point_count).mean() > 0.9, "on their surface, not within"


def points_inside(view: LidarView, margin: float) -> IntArray:
    """(K,) how many points are in each box, made larger by a margin [m] on every side."""
    counts = []
    for center, size, yaw in zip(view.boxes.center, view.boxes.size, view.boxes.yaw, strict=True):
        offset = view.points[np.abs(view.points[:, 0] - center[0]) < 8.0, :3] - center
        c, s = np.cos(yaw), np.sin(yaw)
        along, across = c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0]
        apart = np.abs(np.column_stack([along, across, offset[:, 2]]))
        counts.append((apart < size / 2 + margin).all(axis=1).sum())
    return np.array(counts)


def test_an_agent_never_lists_itself_but_others_do(
    scenario: SimulatedScenario, views: list[dict[str, LidarView]]
) -> None:
    for agent, carrier in scenario.carriers.items():
        assert carrier not in ids(views[0][agent].boxes)
    near = np.hypot(*views[0]["car1"].points[views[0]["car1"].own][:, :2].T)
    assert len(near) == 0 or near.max() < 4.0, "its own body is all around the sensor"
    assert not views[0]["-1"].own.any()


def test_frames_are_those_of_any_data_set(scenario: SimulatedScenario, views: list[dict[str, LidarView]]) -> None:
    frame = scenario[1]
    assert (frame.scenario, frame.timestamp) == (scenario.name, "000002")
    assert frame.time == pytest.approx(0.1)
    assert [agent.is_infrastructure for agent in frame.agents.values()] == [False, False, True]
    np.testing.assert_array_equal(frame.agents["car2"].points, views[1]["car2"].points)
    truth = frame.ground_truth("car1")
    everything = set().union(*(ids(view.boxes).tolist() for view in views[1].values()))
    assert set(ids(truth).tolist()) == everything - {scenario.carriers["car1"]}
    assert truth.label is not None


def test_roadside_unit_is_off_road_seeing_junction(
    scenario: SimulatedScenario, views: list[dict[str, LidarView]]
) -> None:
    poses = [seen["-1"].world_SE3_lidar for seen in views]
    np.testing.assert_array_equal(poses[0], poses[2])  # it does not move
    place = poses[0][:3, 3]
    roads = scenario.world.roads
    assert roads.distance_to_road(place[None, :2])[0] > 1.0
    assert place[2] - scenario.world.scenery.ground.height([place[:2]])[0] == pytest.approx(5.0)
    ahead = place[:2] + np.outer([10.0, 15.0, 20.0], poses[0][:2, 0])
    assert (roads.distance_to_road(ahead) == 0.0).any(), "it looks at the road"
    assert len(views[0]["-1"].boxes) >= 5


def test_many_roadside_units_stand_apart() -> None:
    scenario = SimulatedScenario(
        NETWORK, 4, SETTINGS.model_copy(update={"frames": 1, "agents": 1, "roadside_units": 3})
    )
    places = np.array([pose[:2, 3] for pose in scenario._masts.values()])
    apart = np.hypot(*(places[:, None] - places[None]).transpose(2, 0, 1))[np.triu_indices(3, 1)]
    assert apart.min() > 12.0


def test_scenarios_cycle_networks_of_their_split() -> None:
    drives = list(simulated_scenarios("test", 12, seed=3))
    networks = [scenario.network for scenario in drives]
    assert set(networks) == set(NETWORKS["test"])
    assert len({scenario.seed for scenario in drives}) == len({scenario.name for scenario in drives}) == 12
    assert simulated_scenario("train", 0, 3).seed != drives[0].seed
    assert simulated_scenario("test", 7, 3).seed == drives[7].seed, "one by one the same as in a row"


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda: SimulatedScenario("t_juncton_test_1"), "did you mean 't_junction_test_1'"),
        (lambda: split_of("highway_tset_1"), "did you mean 'highway_test_1'"),
        (lambda: simulated_scenarios("tset", 1), "split must be one of"),
        (lambda: SimulatedScenario(NETWORK, -1), "seed"),
        (lambda: ScenarioSettings(lidar="opv2"), "no sensor 'opv2'"),
        (lambda: ScenarioSettings(rate=3.0), "multiple of 0.1 s"),
        (lambda: ScenarioSettings(agent=3), "did you mean 'agents'"),  # type: ignore[call-arg]
    ],
)
def test_invalid_settings_are_named(wrong, said: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(ValueError, match=said):
        wrong()


# Who is chosen, on made-up traffic


def traffic(rows: Sequence[tuple[int, float, str, int]], frames: int = 3) -> list[TrafficSnapshot]:
    """Vehicles that stand on the x axis; rows of id, x, kind and the number of frames that each stays."""

    def snapshot(index: int) -> TrafficSnapshot:
        here = [row for row in rows if row[3] > index]
        x: FloatArray = np.array([row[1] for row in here])
        one = np.ones(len(here))
        kind = np.array([row[2] for row in here], dtype=np.str_)
        return TrafficSnapshot(
            0.1 * index, np.array([row[0] for row in here]), kind, 4 * one, 2 * one, one, x, 0 * x, 0 * x, one
        )

    return [snapshot(index) for index in range(frames)]


@pytest.mark.parametrize(
    ("what", "rows", "chosen"),
    [
        ("those that stay", [(1, 0, "suv", 3), (2, 5, "suv", 2), (3, 10, "sedan", 3)], {1, 3}),
        ("near each other", [(1, 0, "suv", 3), (2, 200, "suv", 3), (3, 210, "suv", 3)], {2, 3}),
        ("the nearest if none are near", [(1, 0, "suv", 3), (2, 100, "suv", 3), (3, 190, "suv", 3)], {2, 3}),
        ("no motorcycles", [(1, 0, "suv", 3), (2, 5, "motorcycle", 3), (3, 10, "coupe", 3)], {1, 3}),
        ("vans if need be", [(1, 0, "suv", 3), (2, 5, "van", 3)], {1, 2}),
        ("the longest if not enough stay", [(1, 0, "suv", 3), (2, 5, "suv", 2), (3, 9, "motorcycle", 3)], {1, 2}),
    ],
)
def test_agents_are(what: str, rows: list[tuple[int, float, str, int]], chosen: set[int]) -> None:
    found = _choose_agents(traffic(rows), ScenarioSettings(agents=2), np.random.default_rng(0))
    assert set(found) == chosen, what


def test_too_few_vehicles_are_said_so() -> None:
    with pytest.raises(ValueError, match="2 agents requested, but only 1"):
        _choose_agents(traffic([(1, 0.0, "suv", 3)]), ScenarioSettings(agents=2), np.random.default_rng(0))


def test_departed_agent_is_not_in_frame(monkeypatch: pytest.MonkeyPatch) -> None:
    scenario = SimulatedScenario(NETWORK, 4, ScenarioSettings(frames=3, agents=2))
    monkeypatch.setitem(vars(scenario), "traffic", tuple(traffic([(1, 0.0, "suv", 3), (2, 9.0, "suv", 2)])))
    assert [list(frame.agents) for frame in scenario] == [["car1", "car2"], ["car1", "car2"], ["car1"]]
