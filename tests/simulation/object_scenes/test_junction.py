"""Traffic of the junction: paths are smooth, on the right side of the road, and nobody touches anybody."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from shapely.geometry import Polygon

from cobevglue.se2 import wrap_angle
from cobevglue.simulation.object_scenes.junction import junction_path, place_traffic
from cobevglue.simulation.scripted_traffic import Cruise, Vehicle

WEST, SOUTH, EAST, NORTH = range(4)
INNER, OUTER = 1.75, 5.25


def vehicle(
    arm: int, lateral: float, turn: int, start: float = 0.0, speed: float = 10.0, swing: float = 0.0
) -> Vehicle:
    return Vehicle("car", (4.5, 1.9, 1.5), junction_path(arm, lateral, turn), Cruise(start, speed, swing))


@pytest.mark.parametrize(
    ("path", "start", "end", "why"),
    [
        (vehicle(WEST, INNER, 0), (-110, -1.75, 0), (90, -1.75, 0), "from the west straight on: east, on the right"),
        (vehicle(EAST, OUTER, 0), (110, 5.25, 180), (-90, 5.25, 180), "from the east: west, on its own right"),
        (vehicle(SOUTH, INNER, 0), (1.75, -110, 90), (1.75, 90, 90), "from the south: north"),
        (vehicle(NORTH, INNER, 0), (-1.75, 110, -90), (-1.75, -90, -90), "from the north: south"),
        (vehicle(WEST, INNER, 1), (-110, -1.75, 0), (1.75, None, 90), "a left turn from the west leaves to the north"),
        (vehicle(WEST, OUTER, -1), (-110, -5.25, 0), (-5.25, None, -90), "a right turn from the west, to the south"),
        (vehicle(SOUTH, OUTER, -1), (5.25, -110, 90), (None, -5.25, 0), "a right turn from the south, to the east"),
        (vehicle(EAST, INNER, 1), (110, 1.75, 180), (-1.75, None, -90), "a left turn from the east, to the south"),
    ],
)
def test_where_paths_begin_and_end(
    path: Vehicle, start: tuple[float, ...], end: tuple[float | None, ...], why: str
) -> None:
    poses = path.pose(np.array([0.0, 20.0]))
    for pose, expected in zip(poses, (start, end), strict=True):
        for value, wanted in zip(pose[:2], expected[:2], strict=True):
            assert wanted is None or value == pytest.approx(wanted, abs=1e-9), why
        assert expected[2] is not None
        assert wrap_angle(pose[2] - math.radians(expected[2])) == pytest.approx(0.0, abs=1e-9), why


@pytest.mark.parametrize("turn", [-1, 0, 1])
@pytest.mark.parametrize("swing", [0.0, 0.3])
def test_vehicles_move_ahead_and_turn_smoothly(turn: int, swing: float) -> None:
    time = np.arange(0.0, 20.0, 0.01)
    pose = vehicle(SOUTH, OUTER if turn < 0 else INNER, turn, swing=swing).pose(time)
    step = np.diff(pose[:, :2], axis=0)
    speed = np.hypot(*step.T) / 0.01
    heading = np.arctan2(step[:, 1], step[:, 0])
    assert speed.min() > 10 * (1 - swing) - 0.1
    assert speed.max() < 10 * (1 + swing) + 0.1
    assert np.abs(wrap_angle(heading - pose[:-1, 2])).max() < 0.02, "they drive where they look"
    assert np.abs(np.diff(pose[:, 2])).max() < 0.02, "and their heading does not jump"


@pytest.mark.parametrize("seed", range(4))
def test_no_two_vehicles_ever_touch(seed: int) -> None:
    traffic = place_traffic(32, 4, 8.0, np.random.default_rng([seed, 0, 0]))
    for time in np.arange(0.0, 8.0, 0.5):
        footprints = [Polygon(corners) for corners in traffic.at(float(time)).bev_corners()]
        for (i, a), (j, b) in itertools.combinations(enumerate(footprints), 2):
            assert not a.intersects(b), f"vehicles {i} and {j} at {time} s"


@pytest.mark.parametrize("duration", [2.0, 8.0, 15.0])
def test_eight_agents_find_room(duration: float) -> None:
    traffic = place_traffic(8, 8, duration, np.random.default_rng([0, 0, 0]))
    for time in np.arange(0.0, duration, 0.5):
        footprints = [Polygon(corners) for corners in traffic.at(float(time)).bev_corners()]
        assert not any(a.intersects(b) for a, b in itertools.combinations(footprints, 2))


def test_every_class_occurs() -> None:
    labels: set[str] = set()
    for seed in range(5):
        traffic = place_traffic(32, 2, 8.0, np.random.default_rng([seed, 0, 0]))
        speeds = np.array([v.motion.speed for v in traffic.vehicles])
        assert (speeds[:2] > 0).all(), "agents drive"
        assert 8 <= (speeds == 0).sum() <= 20, "some stand"
        assert (speeds > 0).sum() >= 10, "some drive"
        labels |= {v.label for v in traffic.vehicles}
    assert labels == {"car", "van", "truck", "bus"}


def test_full_junction_raises(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("cobevglue.simulation.object_scenes.junction._MAX_FAILURES", 20)
    with pytest.raises(ValueError, match="the junction has room for"):
        place_traffic(300, 2, 1.0, np.random.default_rng([0, 0, 0]))
