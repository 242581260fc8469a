"""A mast over a queue: a roadside unit above vehicles that wait at red, one of them the other agent.

The junction of `junction`, with red for west and east: both lanes of these arms have queues. Vehicles cross from south
and north until the signals change; then the queues drive off, each vehicle a reaction time after the one ahead.
"""

from __future__ import annotations

import math

import numpy as np

from cobevglue.se2 import SE2
from cobevglue.simulation.object_scenes.junction import (
    APPROACH,
    EAST,
    INNER_LANE,
    NORTH,
    OUTER_LANE,
    SOUTH,
    STOP_LINE,
    WEST,
    junction_path,
    parked_beside,
)
from cobevglue.simulation.object_scenes.scene import Mast, Scene
from cobevglue.simulation.scripted_traffic import (
    Cruise,
    Departure,
    Placement,
    Traffic,
    Vehicle,
    mean_size,
    random_kind,
)

__all__ = ["mast_scene"]

_KINDS = {"car": 0.76, "van": 0.14, "truck": 0.06, "bus": 0.04}
_QUEUE = (4, 8)  # least and most vehicles in each lane of the agent's arm
_OTHER_QUEUE = (1, 6)
_AGENT_PLACE = (1, 4)  # of the agent in its lane, 0 first
_GAP = (1.5, 3.2)  # between waiting vehicles [m]
_REACTION = (1.0, 1.5)  # from the departure of a vehicle to that of the one behind [s]
_GREEN = (2.0, 16.0)  # when the signals change [s]
_CLEARANCE_TIME = 2.0  # between the last crossing vehicle at the junction's centre and the change [s]
_SPEED, _ACCELERATION_TIME = 9.0, 6.0  # of the departing vehicles [m/s, s]
_CROSSING, _PARKED = 9, 6  # vehicles that are tried to be placed
_MAST_HEIGHT = (6.0, 8.0)
_MAST_ALONG = (15.0, 35.0)  # from the junction's centre [m]


def mast_scene(rng: np.random.Generator, duration: float) -> Scene:
    """A mast over the queue on the western arm, and an agent that waits in it; either may be the first agent."""
    green = float(rng.uniform(*_GREEN))
    placement = Placement(duration)
    agent_lane = int(rng.integers(2))
    agent_place = int(rng.integers(*_AGENT_PLACE, endpoint=True))
    for arm, numbers in ((WEST, _QUEUE), (EAST, _OTHER_QUEUE)):
        for lane in (0, 1):
            number = int(rng.integers(*numbers, endpoint=True))
            is_agents = arm == WEST and lane == agent_lane
            if is_agents:
                agent_id = len(placement.vehicles) + agent_place
                number = max(number, agent_place + 1)
            for vehicle in _queue(arm, lane, number, agent_place if is_agents else -1, green, rng):
                placement.add_unchecked(vehicle)  # in lanes of their own, one behind another
    for _ in range(_CROSSING):
        placement.add(_crossing(green, rng))
    for _ in range(_PARKED):
        placement.add(parked_beside(rng))
    along = float(rng.uniform(*_MAST_ALONG))
    pose = SE2(-along, -float(rng.uniform(INNER_LANE, OUTER_LANE)), float(rng.uniform(-math.pi, math.pi)))
    mast = Mast(pose, float(rng.uniform(*_MAST_HEIGHT)))
    agents: dict[str, int | Mast] = {"mast": mast, "car": agent_id}
    if rng.random() < 0.5:
        agents = {"car": agent_id, "mast": mast}
    return Scene(Traffic(tuple(placement.vehicles)), agents)


def _queue(arm: int, lane: int, number: int, agent_place: int, green: float, rng: np.random.Generator) -> list[Vehicle]:
    """The vehicles of one lane, the first one at the stop line."""
    front = APPROACH - STOP_LINE - float(rng.uniform(0.0, 1.5))
    leaves = green + float(rng.uniform(0.5, 1.5))
    lateral = (INNER_LANE, OUTER_LANE)[lane]
    queue: list[Vehicle] = []
    for place in range(number):
        label, size = random_kind(rng, _KINDS)
        if place == agent_place:
            label, size = "car", mean_size("car")
        path = junction_path(arm, lateral + float(rng.normal(0.0, 0.12)))
        skew = float(rng.normal(0.0, math.radians(0.6)))
        motion = Departure(front - size[0] / 2.0, leaves, _SPEED, _ACCELERATION_TIME)
        queue.append(Vehicle(label, size, path, motion, skew))
        front -= size[0] + float(rng.uniform(*_GAP))
        leaves += float(rng.uniform(*_REACTION))
    return queue


def _crossing(green: float, rng: np.random.Generator) -> Vehicle:
    """A vehicle from south or north that has passed the centre when the signals change."""
    label, size = random_kind(rng, _KINDS)
    speed = float(rng.uniform(8.0, 12.0))
    path = junction_path(int(rng.choice([SOUTH, NORTH])), float(rng.choice([INNER_LANE, OUTER_LANE])))
    passes = green - _CLEARANCE_TIME - float(rng.uniform(0.0, 12.0))
    swing, period = float(rng.uniform(0.0, 0.15)), float(rng.uniform(5.0, 12.0))
    motion = Cruise(APPROACH - speed * passes, speed, swing, period, float(rng.uniform(-math.pi, math.pi)))
    return Vehicle(label, size, path, motion)
