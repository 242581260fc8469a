"""What all scenes have in common, and what is particular to each."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from shapely.geometry import Polygon

from cobevglue.se2 import wrap_angle
from cobevglue.simulation.object_scenes import SCENES, Mast, Scene
from cobevglue.simulation.object_scenes.roundabout import roundabout_path

DURATION = 10.0
TIMES = np.arange(0.0, DURATION + 0.01, 0.1)


def scene(name: str, seed: int) -> Scene:
    return SCENES[name](np.random.default_rng([seed, 0, 0]), DURATION)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("seed", range(4))
def test_no_two_vehicles_overlap(name: str, seed: int) -> None:
    traffic = scene(name, seed).traffic
    for time in TIMES[::5]:
        boxes = traffic.at(float(time))
        footprints = [Polygon(corners) for corners in boxes.bev_corners()]
        x, y = boxes.center[:, :2].T
        for i, j in itertools.combinations(range(len(boxes)), 2):
            if math.hypot(x[i] - x[j], y[i] - y[j]) < 18.0:
                assert not footprints[i].intersects(footprints[j]), f"vehicles {i} and {j} at {time} s"


@pytest.mark.parametrize("name", SCENES)
def test_same_random_numbers_give_same_scene(name: str) -> None:
    first, again, different = scene(name, 1), scene(name, 1), scene(name, 2)
    assert first == again
    assert first != different


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("seed", range(4))
def test_vehicles_drive_ahead_without_jumps(name: str, seed: int) -> None:
    for vehicle in scene(name, seed).traffic.vehicles:
        poses = vehicle.pose(TIMES)
        step = np.diff(poses[:, :2], axis=0)
        speed = np.hypot(*step.T) / 0.1
        assert speed.max() < 45.0
        assert np.abs(np.diff(speed)).max() < 0.6, "accelerations up to 6 m/s^2"
        assert np.abs(wrap_angle(np.diff(poses[:, 2]))).max() < 0.15, "turn rates up to 1.5 rad/s"
        heading = np.arctan2(step[:, 1], step[:, 0])
        assert np.abs(wrap_angle(heading - poses[1:, 2]))[speed > 0.5].max(initial=0.0) < 0.1


@pytest.mark.parametrize("name", SCENES)
def test_agents_are_cars_or_masts_near_each_other(name: str) -> None:
    for seed in range(4):
        made = scene(name, seed)
        assert len(made.agents) == 2
        for agent in made.agents.values():
            assert isinstance(agent, Mast) or made.traffic.vehicles[agent].label == "car"
        ego, other = (made.pose(agent, DURATION / 2.0) for agent in made.agents)
        assert ego.error_to(other)[0] < 90.0


@pytest.mark.parametrize("seed", range(6))
def test_motorway_has_a_platoon_and_oncoming_traffic(seed: int) -> None:
    made = scene("motorway", seed)
    ego, other = (made.pose(agent, 5.0) for agent in made.agents)
    distance, turn = ego.error_to(other)
    assert 20.0 < distance < 110.0
    assert turn < 0.2, "both drive the same way"
    boxes = made.traffic.at(5.0)
    near = boxes[np.hypot(boxes.center[:, 0] - ego.x, boxes.center[:, 1] - ego.y) < 150.0]
    assert 25 <= len(near) <= 52
    oncoming = np.abs(wrap_angle(near.yaw - ego.yaw)) > 2.5
    assert 8 <= oncoming.sum() <= 28


def test_motorway_vehicles_keep_their_order() -> None:
    made = scene("motorway", 3)
    order = []
    for time in (0.0, 10.0):
        lanes: dict[tuple[object, ...], list[tuple[float, int]]] = {}
        for i, vehicle in enumerate(made.traffic.vehicles):
            travelled = float(vehicle.motion.travelled(np.array([time]))[0])
            lanes.setdefault(vehicle.path.start, []).append((travelled, i))
        order.append({lane: [i for _, i in sorted(row)] for lane, row in lanes.items()})
    assert order[0] == order[1]
    assert len(order[0]) == 6, "lanes"


def test_roundabout_path_follows_circle_and_leaves() -> None:
    for arm, leaves in itertools.product(range(4), range(4)):
        path = roundabout_path(arm, leaves)
        length = sum(part for part, _ in path.segments)
        poses = path.at(np.linspace(0.0, length, 500))
        outwards = leaves * math.pi / 2.0
        assert wrap_angle(poses[-1, 2] - outwards) == pytest.approx(0.0, abs=1e-6), "it leaves along its arm"
        right = np.array([math.sin(outwards), -math.cos(outwards)])
        assert poses[-1, :2] @ right == pytest.approx(2.2, abs=0.6), "in the right lane"
        radius = np.hypot(*poses[:, :2].T)
        assert radius.min() == pytest.approx(18.0, abs=0.8), "and goes round the island"


def test_car_park_is_regular_and_mostly_parked() -> None:
    made = scene("car park", 0)
    speeds = np.array([vehicle.motion.speed for vehicle in made.traffic.vehicles])
    assert (speeds == 0.0).sum() > 100
    assert 3 <= (speeds > 0.0).sum() <= 5
    parked = made.traffic.at(0.0)[np.flatnonzero(speeds == 0.0)]
    offset = parked.center[:, 0] / 2.6 - 0.5
    assert np.abs(offset - np.rint(offset)).max() < 0.1, "in stalls 2.6 m wide"


@pytest.mark.parametrize("seed", range(6))
def test_mast_stands_over_the_agents_queue(seed: int) -> None:
    made = scene("mast", seed)
    (mast,) = (agent for agent in made.agents.values() if isinstance(agent, Mast))
    (car,) = (agent for agent in made.agents.values() if not isinstance(agent, Mast))
    assert 6.0 <= mast.height <= 8.0
    boxes = made.traffic.at(0.0)
    queue = (boxes.center[:, 0] < -15.0) & (np.abs(boxes.center[:, 1] + 3.5) < 2.5) & (np.abs(boxes.yaw) < 0.1)
    assert queue[car]
    assert 6 <= queue.sum() <= 17
    assert boxes.center[queue, 0].min() < mast.world_SE2_mast.x < -15.0
    assert -5.3 < mast.world_SE2_mast.y < -1.7
