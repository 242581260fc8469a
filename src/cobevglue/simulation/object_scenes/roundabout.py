"""A roundabout: four arms with one lane each way, vehicles on the circle and on the arms, short queues at the entries.

The circle's centre is the world's origin; traffic keeps to the right and runs counter-clockwise.
"""

from __future__ import annotations

import math

import numpy as np

from cobevglue.simulation.object_scenes.scene import Scene
from cobevglue.simulation.scripted_traffic import Cruise, Path, Placement, Traffic, Vehicle, mean_size, random_kind

__all__ = ["roundabout_path", "roundabout_scene"]

_CIRCLE, _ENTRY, _LANE = 18.0, 14.0, 2.2  # radii of circle and entry, offset of a lane from its arm's middle [m]
_ALONG = math.sqrt((_CIRCLE + _ENTRY) ** 2 - (_LANE + _ENTRY) ** 2)  # from the origin to the start of an entry [m]
_TANGENT = math.atan2(_LANE + _ENTRY, _ALONG)  # from an arm to the point where an entry meets the circle [rad]
_ARM = 110.0  # length of the straight part of an arm [m]
_TRANSITION = 5.0  # over which a driver turns the steering wheel [m]
_PARKING = 5.2  # offset of parked vehicles from the middle of their arm [m]
_ENTRY_LENGTH = _ENTRY * (math.pi / 2.0 - _TANGENT)
_YIELD_LINE = _ARM + _ENTRY_LENGTH - 6.0  # path length of the front of the first waiting vehicle [m]

_KINDS = {"car": 0.74, "van": 0.14, "truck": 0.06, "bus": 0.06}
_PARKED_KINDS = {"car": 0.85, "van": 0.15}
_PARKED, _DRIVING = (6, 11), (14, 20)  # least and most number of vehicles
_MOST_WAITING = 3  # vehicles at an entry
_TRIES = 60  # for each driving vehicle
_AGENT_START = (12.0, 42.0)  # from the entry at time 0, least and most [m]


def roundabout_scene(rng: np.random.Generator, duration: float) -> Scene:
    """Two agents that come from different arms and drive through the roundabout."""
    placement = Placement(duration)
    arms = rng.permutation(4)
    while len(placement.vehicles) < 2:
        arm = int(arms[len(placement.vehicles)])
        start = _ARM - float(rng.uniform(*_AGENT_START))
        motion = Cruise(start, float(rng.uniform(5.5, 7.5)), float(rng.uniform(0.05, 0.25)), 7.0, _phase(rng))
        path = roundabout_path(arm, arm + int(rng.integers(1, 4)))
        placement.add(Vehicle("car", mean_size("car"), path, motion))
    for _ in range(int(rng.integers(*_PARKED, endpoint=True))):
        placement.add(_parked(rng))
    for arm in arms[2:]:  # the agents' arms are free
        _add_waiting(placement, int(arm), rng)
    stationary = len(placement.vehicles)
    driving = int(rng.integers(*_DRIVING, endpoint=True))
    for _ in range(_TRIES * driving):
        if len(placement.vehicles) - stationary < driving:
            placement.add(_driving(rng, duration))
    return Scene(Traffic(tuple(placement.vehicles)), {"car1": 0, "car2": 1})


def roundabout_path(arm: int, leaves: int) -> Path:
    """From one arm around the circle to another arm (or the same one).

    Args:
        arm: 0 east, 1 north, 2 west, 3 south.
        leaves: likewise, of the exit.
    """
    outwards = arm * math.pi / 2.0
    c, s = math.cos(outwards), math.sin(outwards)
    far = _ALONG + _ARM
    # Inwards on the arm to the east, the right-hand side is the north.
    start = (c * far - s * _LANE, s * far + c * _LANE, outwards + math.pi)
    turn = (leaves - arm) * math.pi / 2.0 - 2.0 * _TANGENT
    around = turn % (2.0 * math.pi)
    segments = ((_ARM, 0.0), (_ENTRY_LENGTH, -1.0 / _ENTRY), (_CIRCLE * around, 1.0 / _CIRCLE))
    return Path(start, (*segments, (_ENTRY_LENGTH, -1.0 / _ENTRY), (_ARM, 0.0))).smoothed(_TRANSITION)


def _parked(rng: np.random.Generator) -> Vehicle:
    """A car or van at the side of an arm."""
    label, size = random_kind(rng, _PARKED_KINDS)
    outwards = int(rng.integers(4)) * math.pi / 2.0
    along, side = _ALONG + float(rng.uniform(12.0, 50.0)), float(rng.choice([-1.0, 1.0])) * _PARKING
    c, s = math.cos(outwards), math.sin(outwards)
    yaw = outwards + (math.pi if side > 0.0 else 0.0) + rng.normal(0.0, math.radians(1.5))
    path = Path((c * along - s * side, s * along + c * side, yaw), ((1.0, 0.0),))
    return Vehicle(label, size, path, Cruise(0.0, 0.0))


def _add_waiting(placement: Placement, arm: int, rng: np.random.Generator) -> None:
    """Vehicles that wait at an entry, one behind another."""
    path = roundabout_path(arm, arm + 2)
    front = _YIELD_LINE - float(rng.uniform(0.0, 1.0))
    for _ in range(int(rng.integers(0, _MOST_WAITING, endpoint=True))):
        label, size = random_kind(rng, _KINDS)
        placement.add(Vehicle(label, size, path, Cruise(front - size[0] / 2.0, 0.0)))
        front -= size[0] + float(rng.uniform(1.5, 3.5))


def _driving(rng: np.random.Generator, duration: float) -> Vehicle:
    """A vehicle that is near or on the circle in the middle of the scene."""
    label, size = random_kind(rng, _KINDS)
    arm = int(rng.integers(4))
    path = roundabout_path(arm, arm + int(rng.choice([1, 2, 3], p=[0.35, 0.4, 0.25])))
    speed = float(rng.uniform(5.0, 8.0))
    halfway = _ARM + float(rng.uniform(-60.0, 130.0))
    motion = Cruise(
        halfway - speed * duration / 2.0,
        speed,
        float(rng.uniform(0.0, 0.25)),
        float(rng.uniform(5.0, 12.0)),
        _phase(rng),
    )
    return Vehicle(label, size, path, motion)


def _phase(rng: np.random.Generator) -> float:
    return float(rng.uniform(-math.pi, math.pi))
