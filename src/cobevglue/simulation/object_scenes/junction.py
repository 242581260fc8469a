"""A four-arm junction with signals: two directions drive, two queue, other vehicles are parked beside the road.

The junction is at the world's origin with arms to the east, north, west and south, two lanes per direction, and
right-hand traffic. East and west have green: their vehicles drive. South and north have red: vehicles queue on the
inner lane, and the outer one is free for turning right. Other vehicles are parked beside the road.
"""

from __future__ import annotations

import math
from dataclasses import replace

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
)

__all__ = [
    "APPROACH",
    "EAST",
    "INNER_LANE",
    "NORTH",
    "OUTER_LANE",
    "SOUTH",
    "STOP_LINE",
    "WEST",
    "junction_path",
    "junction_scene",
    "parked_beside",
    "place_traffic",
]

INNER_LANE, OUTER_LANE = 1.75, 5.25
"""Offsets of the lanes to the right of the road's centre line [m]."""
STOP_LINE = 17.0
"""From the junction's centre to the first queueing vehicle [m]."""
APPROACH = 110.0
"""From the start of a path (path length 0) to the junction's centre [m]."""
WEST, SOUTH, EAST, NORTH = 0, 1, 2, 3
"""Arms by the quarter turns from "coming from the west, driving east"."""

_PARKING = 8.6  # offset to the right of the road's centre line [m]
_JUNCTION_HALF = 14.0  # from the junction's centre to the start of turning arcs [m]
_STRAIGHT, _LEFT, _RIGHT = 0, 1, -1
_KINDS = {"car": 0.7, "van": 0.14, "truck": 0.08, "bus": 0.08}
_PARKED_KINDS = {"car": 0.7, "van": 0.14}
_AGENT_STARTS = ((WEST, _STRAIGHT, 42.0), (SOUTH, _RIGHT, 38.0), (EAST, _STRAIGHT, 34.0), (NORTH, _RIGHT, 32.0))
_AGENT_SPACING = 22.0  # between agents on the same arm [m]
_MAX_FAILURES = 300  # consecutive failures after which the junction is full
_VEHICLES = 32


def junction_scene(rng: np.random.Generator, duration: float) -> Scene:
    """Two agents that approach the junction from the west and from the south, among 30 other vehicles."""
    return Scene(place_traffic(_VEHICLES, 2, duration, rng), {"car1": 0, "car2": 1})


def place_traffic(n_vehicles: int, n_agents: int, duration: float, rng: np.random.Generator) -> Traffic:
    """Random traffic at the junction without collisions; the agents are the first vehicles.

    Args:
        n_vehicles: number of vehicles including agents: about a quarter are parked, a fifth queue, the others drive.
        n_agents: number of agents, at most 8. They come from the west, south, east and north in turn, and drive.
        duration: of the scene [s].
        rng: random generator.

    Raises:
        ValueError: too many vehicles for the junction.
    """
    placement = Placement(duration)
    for agent in _agents(n_agents, rng):
        placement.add_unchecked(agent)
    failures = 0
    while (n := len(placement.vehicles)) < n_vehicles:
        share = (n - n_agents) / n_vehicles  # stationary vehicles first: the others are placed around them
        if failures > _MAX_FAILURES / 5:  # no place for this kind of vehicle: try all kinds
            share = rng.random()
        if placement.add(
            parked_beside(rng) if share < 0.27 else _queueing(rng) if share < 0.47 else _driving(rng, duration)
        ):
            failures = 0
            continue
        failures += 1
        if failures == _MAX_FAILURES:
            raise ValueError(f"the junction has room for {n} vehicles, {n_vehicles} were requested")
    return Traffic(tuple(placement.vehicles))


def junction_path(arm: int, lateral: float, turn: int = _STRAIGHT) -> Path:
    """The path of a vehicle that comes from an arm: straight, or a quarter circle to the same lane of another arm.

    Args:
        arm: `WEST`, `SOUTH`, `EAST` or `NORTH`.
        lateral: offset of the path to the right of the road's centre line [m].
        turn: 0 straight on, 1 left, -1 right.
    """
    turned = arm * math.pi / 2.0
    c, s = math.cos(turned), math.sin(turned)
    start = (-c * APPROACH + s * lateral, -s * APPROACH - c * lateral, turned)
    if turn == _STRAIGHT:
        return Path(start, ((2.0 * APPROACH, 0.0),))
    radius = _JUNCTION_HALF + turn * lateral  # the arc ends on the same lane of the exit arm
    arc = radius * math.pi / 2.0
    return Path(start, ((APPROACH - _JUNCTION_HALF, 0.0), (arc, turn / radius), (APPROACH, 0.0)))


def parked_beside(rng: np.random.Generator) -> Vehicle:
    """A car or van that is parked at the side of a random arm."""
    label, size = random_kind(rng, _PARKED_KINDS)
    along = rng.uniform(22.0, 62.0) * rng.choice([-1.0, 1.0])
    path = junction_path(int(rng.integers(4)), _PARKING)
    return Vehicle(label, size, path, Cruise(APPROACH + along, 0.0), skew=rng.normal(0.0, math.radians(1.5)))


def _agents(number: int, rng: np.random.Generator) -> list[Vehicle]:
    """Cars that approach the junction; those beyond the fourth follow the first four at their speed."""
    agents: list[tuple[Path, Cruise]] = []
    for arm, turn, distance in _AGENT_STARTS:
        lateral, speed = (OUTER_LANE, 5.5) if turn else (INNER_LANE, 8.0)
        start = APPROACH - distance - rng.uniform(-5.0, 5.0)
        speed *= rng.uniform(0.85, 1.15)
        phase = rng.uniform(-math.pi, math.pi)
        agents.append((junction_path(arm, lateral, turn), Cruise(start, speed, swing=0.2, phase=phase)))
    agents += [(path, replace(leader, start=leader.start - _AGENT_SPACING)) for path, leader in agents]
    return [Vehicle("car", mean_size("car"), path, motion) for path, motion in agents[:number]]


def _queueing(rng: np.random.Generator) -> Vehicle:
    """A vehicle that waits at red."""
    label, size = random_kind(rng, _KINDS)
    path = junction_path(int(rng.choice([SOUTH, NORTH])), INNER_LANE)
    front = STOP_LINE + rng.uniform(0.0, 40.0)
    skew = rng.normal(0.0, math.radians(0.5))
    return Vehicle(label, size, path, Cruise(APPROACH - front - size[0] / 2.0, 0.0), skew)


def _driving(rng: np.random.Generator, duration: float) -> Vehicle:
    """A vehicle that has green and is near the junction in the middle of the scene."""
    label, size = random_kind(rng, _KINDS)
    arm = int(rng.choice([WEST, EAST]))
    turn = int(rng.choice([_STRAIGHT, _LEFT, _RIGHT], p=[0.64, 0.18, 0.18]))
    lateral = {_LEFT: INNER_LANE, _RIGHT: OUTER_LANE, _STRAIGHT: float(rng.choice([INNER_LANE, OUTER_LANE]))}[turn]
    speed = float(rng.uniform(4.5, 6.5) if turn else rng.uniform(7.0, 12.0))
    halfway = APPROACH + rng.uniform(-70.0, 70.0)
    motion = Cruise(
        halfway - speed * duration / 2.0,
        speed,
        swing=rng.uniform(0.0, 0.3),
        period=rng.uniform(5.0, 12.0),
        phase=rng.uniform(-math.pi, math.pi),
    )
    return Vehicle(label, size, junction_path(arm, lateral, turn), motion)
