"""A motorway platoon: two agents in a row of vehicles, three lanes each way in a gentle bend, oncoming traffic.

The order within a lane stays: each vehicle repeats the speed of the one ahead a reaction time later, and the mean
speeds within a lane differ by a few percent at most. Some 36 vehicles are within 150 m of the platoon at any time.
"""

from __future__ import annotations

import math

import numpy as np

from cobevglue.simulation.object_scenes.scene import Scene
from cobevglue.simulation.scripted_traffic import Cruise, Path, Placement, Traffic, Vehicle, mean_size, random_kind

__all__ = ["motorway_scene"]

_LANES = {  # offset to the right of the centre line [m]: mean speed [m/s], kinds of vehicles
    5.0: (34.0, {"car": 0.92, "van": 0.08}),
    8.75: (29.5, {"car": 0.8, "van": 0.15, "bus": 0.02, "truck": 0.03}),
    12.5: (23.5, {"car": 0.35, "van": 0.15, "bus": 0.05, "truck": 0.15, "semitrailer": 0.3}),
}
_PLATOON_LANE = 8.75
_REACTION = 1.1  # time after which a vehicle repeats the speed of the one ahead [s]
_LEAST_GAP, _MEAN_GAP = 0.8, 1.4  # from a vehicle to the one ahead in its lane [s]
_PLATOON_GAP = (0.7, 1.2)  # the same within the platoon, least and most [s]
_PLATOON = 6  # vehicles
_REACH = 150.0  # of the traffic ahead of and behind the platoon's middle [m]
_OWN_SPEED_STD = 0.015  # of a vehicle's mean speed, relative to that of its lane
_MOST_CURVATURE = 1.0 / 800.0  # [1/m]


def motorway_scene(rng: np.random.Generator, duration: float) -> Scene:
    """Two agents in a platoon in the middle lane, next to each other or with one vehicle between them."""
    curvature = float(rng.uniform(-_MOST_CURVATURE, _MOST_CURVATURE))
    speed = _LANES[_PLATOON_LANE][0] * float(rng.uniform(0.92, 1.05))
    apart = int(rng.integers(1, 3))
    placement = Placement(duration)
    rear = _add_platoon(placement, _lane_path(_PLATOON_LANE, curvature, 1), speed, rng, apart)
    front_halfway = speed * duration / 2.0
    middle, gap = front_halfway + rear / 2.0, _MEAN_GAP * speed
    for direction in (1, -1):
        for lateral, (lane_speed, kinds) in _LANES.items():
            path = _lane_path(lateral, curvature, direction)
            if direction == 1 and lateral == _PLATOON_LANE:
                own = speed
                stretches = [(front_halfway + gap, middle + _REACH), (middle - _REACH, front_halfway + rear)]
            else:
                own = lane_speed * float(rng.uniform(0.95, 1.05))
                reach = _REACH + abs(own - direction * speed) * duration / 2.0
                stretches = [(direction * middle - reach, direction * middle + reach)]
            for stretch in stretches:
                _add_lane(placement, path, own, kinds, stretch, duration, rng)
    agents = [0, apart] if rng.random() < 0.5 else [apart, 0]
    return Scene(Traffic(tuple(placement.vehicles)), {"car1": agents[0], "car2": agents[1]})


def _lane_path(lateral: float, curvature: float, direction: int) -> Path:
    """A lane of direction 1 or -1, to the right of the centre line, in a bend with this curvature along direction 1."""
    left = -direction * lateral  # of the centre line as seen along direction 1
    own = direction * curvature / (1.0 - curvature * left)
    return Path((0.0, left, 0.0 if direction == 1 else math.pi), ((1.0, own),))


def _add_platoon(placement: Placement, path: Path, speed: float, rng: np.random.Generator, apart: int) -> float:
    """A row of vehicles with small gaps, its front at path length 0 at time 0.

    The agents, cars of mean size, are the vehicles 0 and `apart`. Returns the path length of the next vehicle [m].
    """
    swing, period, phase = _wave(rng)
    first = int(rng.integers(0, _PLATOON - apart))  # agent, counted from the front
    members: list[Vehicle] = []
    position = 0.0
    for i in range(_PLATOON):
        label, size = random_kind(rng, _LANES[_PLATOON_LANE][1])
        if i in (first, first + apart):
            label, size = "car", mean_size("car")
        position -= size[0] / 2.0
        delayed = phase - 2.0 * math.pi / period * _REACTION * i
        members.append(Vehicle(label, size, path, Cruise(position, speed, swing, period, delayed)))
        position -= size[0] / 2.0 + speed * float(rng.uniform(*_PLATOON_GAP))
    for member in members[first:] + members[:first]:  # from the first agent on, so that its id is 0
        placement.add_unchecked(member)
    return position


def _add_lane(
    placement: Placement,
    path: Path,
    speed: float,
    kinds: dict[str, float],
    stretch: tuple[float, float],
    duration: float,
    rng: np.random.Generator,
) -> None:
    """Vehicles one behind another, which are on this stretch of the path [m] in the middle of the scene."""
    swing, period, phase = _wave(rng)
    position, i = stretch[1] - speed * _MEAN_GAP * float(rng.random()), 0
    while position > stretch[0]:
        label, size = random_kind(rng, kinds)
        own = speed * (1.0 + _OWN_SPEED_STD * float(np.clip(rng.standard_normal(), -2.0, 2.0)))
        delayed = phase - 2.0 * math.pi / period * _REACTION * i
        placement.add(Vehicle(label, size, path, Cruise(position - own * duration / 2.0, own, swing, period, delayed)))
        position -= size[0] + speed * (_LEAST_GAP + float(rng.exponential(_MEAN_GAP - _LEAST_GAP)))
        i += 1


def _wave(rng: np.random.Generator) -> tuple[float, float, float]:
    """Swing, period [s] and phase [rad] of the speed of a lane."""
    return float(rng.uniform(0.01, 0.05)), float(rng.uniform(6.0, 14.0)), float(rng.uniform(-math.pi, math.pi))
