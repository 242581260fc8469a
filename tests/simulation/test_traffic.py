"""SUMO traffic: the same from the same seed, on the roads, nobody inside anybody, boxes where the vehicles are."""

from __future__ import annotations

import itertools
import math
import subprocess
import sys

import numpy as np
import pytest

from cobevglue.iou import bev_iou
from cobevglue.se2 import wrap_angle
from cobevglue.simulation.road_network import NETWORK_KINDS, NETWORKS
from cobevglue.simulation.traffic import VEHICLE_KINDS, Traffic, TrafficSettings, TrafficSnapshot

libsumo = pytest.importorskip("libsumo")

ALL = [name for names in NETWORKS.values() for name in names]
ONE_OF_EACH_KIND = [f"{kind}_train_1" for kind in NETWORK_KINDS]
SHORT = TrafficSettings(vehicles=20, warm_up=3.0)


def contents(snapshot: TrafficSnapshot) -> bytes:
    columns = ("id", "kind", "length", "width", "height", "x", "y", "yaw", "speed")
    return b"".join(np.ascontiguousarray(getattr(snapshot, column)).tobytes() for column in columns)


def run(network: str, seed: int, steps: list[float]) -> bytes:
    with Traffic(network, seed, SHORT) as traffic:
        for seconds in steps:
            traffic.step(seconds)
        return contents(traffic.vehicles())


def test_the_seed_decides_everything() -> None:
    first = run("junction_train_0", 7, [2.0])
    assert run("junction_train_0", 7, [2.0]) == first
    assert run("junction_train_0", 8, [2.0]) != first


def test_number_of_steps_does_not_matter() -> None:
    assert run("roundabout_train_0", 1, [0.1] * 20) == run("roundabout_train_0", 1, [0.3, 1.2, 0.5])


@pytest.mark.parametrize("name", ALL)
def test_every_network_has_traffic_on_its_roads(name: str) -> None:
    with Traffic(name, 0, SHORT) as traffic:
        now = traffic.vehicles()
        assert 12 <= len(now) <= traffic.target == 20
        assert traffic.roads.distance_to_road(np.column_stack([now.x, now.y])).max() == 0.0
        assert (now.speed > 1.0).any()


@pytest.mark.parametrize("name", ONE_OF_EACH_KIND)
def test_vehicles_drive_forward_without_collision(name: str) -> None:
    with Traffic(name, 2) as traffic:
        before = traffic.vehicles()
        assert len(before) > 0.8 * traffic.target, "the scene is full from its beginning"
        for _ in range(8):
            traffic.step(0.5)
            overlap = bev_iou(traffic.vehicles().boxes(), traffic.vehicles().boxes())
            assert (overlap - np.eye(len(overlap))).max() < 0.1
            before = traffic.vehicles()
            traffic.step(0.1)
            now = traffic.vehicles()
            _, old, new = np.intersect1d(before.id, now.id, return_indices=True)
            moved = np.column_stack([now.x[new] - before.x[old], now.y[new] - before.y[old]])
            driving = now.speed[new] > 3.0
            aside = wrap_angle(np.arctan2(moved[:, 1], moved[:, 0]) - now.yaw[new])[driving]
            # The middle of a long vehicle that turns does not move exactly along it.
            assert np.degrees(np.abs(aside)).max(initial=0.0) < 30.0
            assert np.degrees(np.median(np.abs(aside))) < 3.0
            assert np.median(np.abs(np.hypot(*moved.T) - 0.1 * now.speed[new])) < 0.05


def test_boxes_reach_from_the_front_bumper_backwards() -> None:
    with Traffic("junction_train_0", 3) as traffic:
        now = traffic.vehicles()
        for row, name in enumerate(now.id):
            x, y = libsumo.vehicle.getPosition(str(name))
            angle = math.radians(libsumo.vehicle.getAngle(str(name)))  # clockwise from north
            assert now.x[row] == pytest.approx(x - now.length[row] / 2 * math.sin(angle))
            assert now.y[row] == pytest.approx(y - now.length[row] / 2 * math.cos(angle))


def test_queue_gaps_are_between_bumpers() -> None:
    """Fronts in a queue are the leader's length and a gap apart; without the shift of positions gaps would be wrong."""
    gaps = []
    with Traffic("junction_train_2", 5) as traffic:
        now = traffic.vehicles()
        lanes = np.array([libsumo.vehicle.getLaneID(str(name)) for name in now.id])
        along = np.array([libsumo.vehicle.getLanePosition(str(name)) for name in now.id])
        for lane in sorted(set(lanes)):
            queue = np.flatnonzero((lanes == lane) & (now.speed < 0.05))
            queue = queue[np.argsort(-along[queue])]
            for leader, follower in itertools.pairwise(queue):
                between = math.hypot(now.x[leader] - now.x[follower], now.y[leader] - now.y[follower])
                gap = between - (now.length[leader] + now.length[follower]) / 2
                gaps.append(gap)
    assert len(gaps) >= 5
    assert min(gaps) > 0.5
    assert 1.0 < np.median(gaps) < 3.5


def test_sizes_are_those_of_their_kinds_and_stay() -> None:
    sizes: dict[int, tuple[float, float, float]] = {}
    kinds = set()
    with Traffic("highway_train_1", 0) as traffic:
        for _ in range(5):
            now = traffic.vehicles()
            kinds |= set(now.kind.tolist())
            for name, *size in zip(now.id, now.length, now.width, now.height, strict=True):
                assert sizes.setdefault(int(name), tuple(size)) == tuple(size)
            traffic.step(1.0)
    assert kinds <= set(VEHICLE_KINDS)
    assert {"hatchback", "sedan", "suv", "van", "truck"} <= kinds
    length, width, height = np.array(list(sizes.values())).T
    assert (length >= 1.9).all()
    assert (length <= 13.0).all()
    assert (width <= 2.7).all()
    assert (height <= 3.9).all()
    assert (length > width).all()


def test_time_counts_from_the_beginning_of_the_scene() -> None:
    with Traffic("t_junction_train_0", 0, SHORT) as traffic:
        assert traffic.time == 0.0
        traffic.step(0.3)
        assert traffic.vehicles().time == pytest.approx(0.3)


@pytest.mark.parametrize("seconds", [0.0, -0.1, 0.05, 0.25, math.nan, math.inf])
def test_time_passes_in_tenths_of_seconds(seconds: float) -> None:
    with Traffic("t_junction_train_0", 0, SHORT) as traffic, pytest.raises(ValueError, match=r"multiple of 0\.1"):
        traffic.step(seconds)


def test_one_simulation_a_process() -> None:
    with Traffic("t_junction_train_0", 0, SHORT) as first:
        with pytest.raises(RuntimeError, match=r"close\(\) the other Traffic first"):
            Traffic("t_junction_train_1", 0, SHORT)
        first.step(0.1)
    with pytest.raises(RuntimeError, match="this Traffic is closed"):
        first.step(0.1)
    with Traffic("t_junction_train_1", 0, SHORT) as second:
        first.close()  # it has nothing to close any more
        assert len(second.vehicles())


def test_a_forgotten_simulation_is_not_in_the_way() -> None:
    Traffic("t_junction_train_0", 0, SHORT)
    with Traffic("t_junction_train_0", 0, SHORT) as traffic:
        assert len(traffic.vehicles())


def test_unknown_network_error_names_nearest() -> None:
    with pytest.raises(ValueError, match="did you mean 'highway_test_1'"):
        Traffic("highway_tset_1")


def test_missing_sumo_error_names_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "libsumo", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install cobevglue\[simulation\]"):
        Traffic("junction_train_0")


def test_importing_the_module_does_not_import_sumo() -> None:
    code = "import sys, cobevglue.simulation.traffic; sys.exit('libsumo' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
