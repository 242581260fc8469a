"""A regular car park: two agents drive slowly between rows of parked cars, with few other movers.

Double rows of stalls run along x, the parked cars stand across, nose to nose; between the rows are aisles in which
vehicles drive on the right. A pose that is off by a stall, by a row, or turned round looks much like the true one.
"""

from __future__ import annotations

import math

import numpy as np

from cobevglue.simulation.object_scenes.scene import Scene
from cobevglue.simulation.scripted_traffic import (
    Cruise,
    Path,
    Placement,
    Traffic,
    Vehicle,
    mean_size,
    random_kind,
    stationary,
)

__all__ = ["car_park_scene"]

_STALL_WIDTH, _STALL_LENGTH, _AISLE = 2.6, 5.5, 6.8  # [m]
_PITCH = 2.0 * _STALL_LENGTH + _AISLE  # from aisle to aisle [m]
_AISLES, _STALLS = 4, 32  # aisles, and stalls along each of their two sides
_KINDS = {"car": 0.92, "van": 0.08}
_OCCUPIED = (0.5, 0.85)  # least and most share of the stalls
_BACKED_IN = 0.3
_LONGEST = 5.2  # vehicle that parks in a stall [m]
_MARGIN = 0.15  # from the aisle to a parked vehicle [m]
_SIDE_STD, _ALONG_STD, _SKEW_STD = 0.06, 0.06, math.radians(0.8)  # of the places of parked vehicles, cut at two of each
_LANE = 1.6  # offset of a vehicle to the right of its aisle's middle [m]
_MOVERS = (1, 3)  # least and most number beside the agents
_TRIES = 30


def car_park_scene(rng: np.random.Generator, duration: float) -> Scene:
    """Two agents in the same aisle or in neighbouring ones, 10 to 30 m apart along the rows, either way round."""
    placement = Placement(duration)
    aisle = int(rng.integers(0, _AISLES - 1))
    other = aisle + int(rng.integers(0, 2))
    middle = float(rng.uniform(-12.0, 12.0))
    apart = float(rng.uniform(10.0, 30.0)) * float(rng.choice([-1.0, 1.0]))
    directions = rng.choice([-1, 1], 2)
    for row, x, direction in (
        (aisle, middle - apart / 2.0, directions[0]),
        (other, middle + apart / 2.0, directions[1]),
    ):
        placement.add_unchecked(_driving("car", mean_size("car"), row, x, int(direction), duration, rng))
    for _ in range(int(rng.integers(*_MOVERS, endpoint=True))):
        for _ in range(_TRIES):
            label, size = random_kind(rng, _KINDS)
            x = float(rng.uniform(-40.0, 40.0))
            direction = int(rng.choice([-1, 1]))
            if placement.add(_driving(label, size, int(rng.integers(_AISLES)), x, direction, duration, rng)):
                break
    share = float(rng.uniform(*_OCCUPIED))
    for row in range(_AISLES):
        for side in (-1, 1):
            for stall in range(_STALLS):
                if rng.random() < share:
                    # Stalls are larger than the vehicles in them, wherever these stand: no check is needed.
                    placement.add_unchecked(_parked(row, side, stall, rng))
    return Scene(Traffic(tuple(placement.vehicles)), {"car1": 0, "car2": 1})


def _aisle_y(aisle: int) -> float:
    return (aisle - (_AISLES - 1) / 2.0) * _PITCH


def _parked(aisle: int, side: int, stall: int, rng: np.random.Generator) -> Vehicle:
    """A car in a stall; `side` is 1 to the north of the aisle, -1 to the south."""
    label, size = random_kind(rng, _KINDS)
    while size[0] > _LONGEST:
        label, size = random_kind(rng, _KINDS)
    across, along, skew = np.clip(rng.standard_normal(3), -2.0, 2.0) * (_SIDE_STD, _ALONG_STD, _SKEW_STD)
    x = (stall - (_STALLS - 1) / 2.0) * _STALL_WIDTH + float(across)
    y = _aisle_y(aisle) + side * (_AISLE / 2.0 + _MARGIN + size[0] / 2.0 + float(along))
    nose = side if rng.random() >= _BACKED_IN else -side
    return stationary(label, size, x, y, nose * math.pi / 2.0 + float(skew))


def _driving(
    label: str,
    size: tuple[float, float, float],
    aisle: int,
    x: float,
    direction: int,
    duration: float,
    rng: np.random.Generator,
) -> Vehicle:
    """A vehicle that drives slowly along an aisle, to the east (1) or west (-1), and is at `x` in mid-scene."""
    speed = float(rng.uniform(1.5, 4.5))
    path = Path((0.0, _aisle_y(aisle) - direction * _LANE, 0.0 if direction == 1 else math.pi), ((1.0, 0.0),))
    motion = Cruise(
        direction * x - speed * duration / 2.0, speed, float(rng.uniform(0.1, 0.4)), 8.0, float(rng.uniform(-3.0, 3.0))
    )
    return Vehicle(label, size, path, motion)
