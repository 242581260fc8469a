"""Vehicles on scripted paths over a four-arm junction: who is where at any time, as a closed formula.

The junction is at the world's origin with arms to the east, north, west and south, two lanes a direction, and traffic
on the right. East and west have green: their vehicles drive. South and north have red: theirs queue on the inner lane,
and the outer one is free for turning right. Others are parked beside the road. Nobody reacts to anybody; a vehicle that
would touch another one at any time of the scene is not placed at all.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.typing import BoolArray, FloatArray

__all__ = ["LIDAR_HEIGHT", "Traffic", "Vehicle", "place_traffic"]

LIDAR_HEIGHT = 1.9
"""Every agent's LiDAR is this high above the ground [m]; the world's z = 0 is at this height too."""

_INNER_LANE, _OUTER_LANE, _PARKING = 1.75, 5.25, 8.6  # to the right of the road's middle line [m]
_JUNCTION_HALF = 14.0  # from the junction's centre to where arcs begin [m]
_STOP_LINE = 17.0  # where queues begin, from the centre [m]
_APPROACH = 110.0  # a path's s = 0 is this far before the centre [m]
_WEST, _SOUTH, _EAST, _NORTH = 0, 1, 2, 3  # arms, by the quarter turns from "coming from the west, driving east"
_STRAIGHT, _LEFT, _RIGHT = 0, 1, -1

_KINDS = ("car", "van", "truck", "bus")
_KIND_SHARES = (0.7, 0.14, 0.08, 0.08)
_SIZES = {  # mean and spread of length, width, height [m]
    "car": ((4.5, 1.85, 1.55), (0.3, 0.07, 0.08)),
    "van": ((5.4, 2.0, 2.2), (0.4, 0.06, 0.2)),
    "truck": ((8.5, 2.5, 3.2), (0.9, 0.04, 0.25)),
    "bus": ((11.9, 2.55, 3.1), (0.4, 0.02, 0.1)),
}
_AGENT_STARTS = ((_WEST, _STRAIGHT, 42.0), (_SOUTH, _RIGHT, 38.0), (_EAST, _STRAIGHT, 34.0), (_NORTH, _RIGHT, 32.0))
_AGENT_SPACING = 22.0  # between agents that come from the same arm [m]
_CLEARANCE = 0.25  # vehicles keep at least this far apart, each [m]
_CHECK_STEP = 0.1  # how finely a scene is searched for contacts [s]
_TRIES = 300  # failures in a row before the junction counts as full
_DISCS = np.array([-0.42, -0.21, 0.0, 0.21, 0.42])  # a footprint as five discs, in lengths from its centre


@dataclass(frozen=True, slots=True)
class Vehicle:
    """One vehicle and where it is at any time.

    Attributes:
        label: "car", "van", "truck" or "bus".
        size: length, width, height [m].
        arm: where it comes from, in quarter turns from the west: 0 west, 1 south, 2 east, 3 north.
        lateral: how far its path is to the right of the road's middle line [m].
        turn: 0 straight on, 1 left, -1 right.
        start: path length at time 0 [m]; the junction's centre is 110 m from the path's beginning if it is straight.
        speed: mean speed [m/s]; 0 for one that stands.
        swing: the speed varies by this fraction of its mean, below 1.
        period: how long one such variation takes [s].
        phase: where in the variation time 0 is [rad].
        skew: constant heading error against the path [rad]: parked cars stand a little askew.
    """

    label: str
    size: tuple[float, float, float]
    arm: int
    lateral: float
    turn: int
    start: float
    speed: float
    swing: float = 0.0
    period: float = 8.0
    phase: float = 0.0
    skew: float = 0.0

    def travelled(self, time: FloatArray) -> FloatArray:
        """Path length at these times [m]: the integral of `speed * (1 + swing * cos(...))`."""
        rate = 2.0 * math.pi / self.period
        wave: FloatArray = np.sin(rate * time + self.phase) - math.sin(self.phase)
        return self.start + self.speed * (time + self.swing / rate * wave)

    def pose(self, time: FloatArray) -> FloatArray:
        """(T, 3) x, y [m] and yaw [rad] in the world at these times (T,) [s]."""
        path = _along_path(self.travelled(time), self.lateral, self.turn)
        turned = self.arm * math.pi / 2.0
        c, s = math.cos(turned), math.sin(turned)
        x, y, yaw = path.T
        return np.column_stack([c * x - s * y, s * x + c * y, yaw + turned + self.skew])


@dataclass(frozen=True, slots=True)
class Traffic:
    """All vehicles of a scene; the first `n_agents` of them are the agents.

    Attributes:
        vehicles: the vehicles; a vehicle's object id is its place here.
        n_agents: how many of them are agents.
    """

    vehicles: tuple[Vehicle, ...]
    n_agents: int

    def at(self, time: float) -> Boxes:
        """Every vehicle in the world frame at this time [s], with track ids (object ids) and labels."""
        poses = np.concatenate([vehicle.pose(np.array([time])) for vehicle in self.vehicles])
        size = np.array([vehicle.size for vehicle in self.vehicles])
        return Boxes(
            center=np.column_stack([poses[:, :2], size[:, 2] / 2.0 - LIDAR_HEIGHT]),
            size=size,
            yaw=poses[:, 2],
            track_id=np.arange(len(self.vehicles)),
            label=[vehicle.label for vehicle in self.vehicles],
        )


def place_traffic(n_vehicles: int, n_agents: int, duration: float, rng: np.random.Generator) -> Traffic:
    """A junction's traffic in which no two vehicles touch while the scene lasts.

    Args:
        n_vehicles: how many, agents included: about a quarter are parked, a fifth queue, the others drive.
        n_agents: how many of them are agents, at most 8. They come from the west, south, east and north in turn, and
            drive.
        duration: how long the scene lasts [s].
        rng: the only source of chance.

    Raises:
        ValueError: the junction has no room for that many vehicles.
    """
    times = np.arange(0.0, duration + _CHECK_STEP, _CHECK_STEP)
    placed = _agents(n_agents, rng)
    discs = [_discs(vehicle, times) for vehicle in placed]
    tries = 0
    while len(placed) < n_vehicles:
        share = (len(placed) - n_agents) / n_vehicles  # standing vehicles first: the others then go around them
        if tries > _TRIES / 5:  # where these stand is full: the rest goes wherever there is room
            share = rng.random()
        candidate = _parked(rng) if share < 0.27 else _queueing(rng) if share < 0.47 else _driving(rng, duration)
        covered = _discs(candidate, times)
        if any(_touch(covered, other).any() for other in discs):
            tries += 1
            if tries == _TRIES:
                raise ValueError(f"the junction has room for {len(placed)} vehicles, {n_vehicles} were asked for")
            continue
        tries = 0
        placed.append(candidate)
        discs.append(covered)
    return Traffic(tuple(placed), n_agents)


def _agents(number: int, rng: np.random.Generator) -> list[Vehicle]:
    """Cars that drive towards the junction; those beyond the fourth follow the first four at their speed."""
    size = _SIZES["car"][0]
    agents: list[Vehicle] = []
    for arm, turn, distance in _AGENT_STARTS:
        lateral, speed = (_OUTER_LANE, 5.5) if turn else (_INNER_LANE, 8.0)
        start = _APPROACH - distance - rng.uniform(-5.0, 5.0)
        speed *= rng.uniform(0.85, 1.15)
        phase = rng.uniform(-math.pi, math.pi)
        agents.append(Vehicle("car", size, arm, lateral, turn, start, speed, swing=0.2, phase=phase))
    followers = [replace(leader, start=leader.start - _AGENT_SPACING) for leader in agents]
    return (agents + followers)[:number]


def _parked(rng: np.random.Generator) -> Vehicle:
    label, size = _kind(rng, ("car", "van"))
    along = rng.uniform(22.0, 62.0) * rng.choice([-1.0, 1.0])
    arm = int(rng.integers(4))
    return Vehicle(
        label, size, arm, _PARKING, _STRAIGHT, _APPROACH + along, 0.0, skew=rng.normal(0.0, math.radians(1.5))
    )


def _queueing(rng: np.random.Generator) -> Vehicle:
    """One that waits at red."""
    label, size = _kind(rng)
    arm = int(rng.choice([_SOUTH, _NORTH]))
    front = _STOP_LINE + rng.uniform(0.0, 40.0)
    skew = rng.normal(0.0, math.radians(0.5))
    return Vehicle(label, size, arm, _INNER_LANE, _STRAIGHT, _APPROACH - front - size[0] / 2.0, 0.0, skew=skew)


def _driving(rng: np.random.Generator, duration: float) -> Vehicle:
    """One that has green, somewhere on its way through at the middle of the scene."""
    label, size = _kind(rng)
    arm = int(rng.choice([_WEST, _EAST]))
    turn = int(rng.choice([_STRAIGHT, _LEFT, _RIGHT], p=[0.64, 0.18, 0.18]))
    lateral = {_LEFT: _INNER_LANE, _RIGHT: _OUTER_LANE, _STRAIGHT: float(rng.choice([_INNER_LANE, _OUTER_LANE]))}[turn]
    speed = float(rng.uniform(4.5, 6.5) if turn else rng.uniform(7.0, 12.0))
    halfway = _APPROACH + rng.uniform(-70.0, 70.0)
    return Vehicle(
        label,
        size,
        arm,
        lateral,
        turn,
        halfway - speed * duration / 2.0,
        speed,
        swing=rng.uniform(0.0, 0.3),
        period=rng.uniform(5.0, 12.0),
        phase=rng.uniform(-math.pi, math.pi),
    )


def _kind(rng: np.random.Generator, among: tuple[str, ...] = _KINDS) -> tuple[str, tuple[float, float, float]]:
    """A label, by how common the kinds are, and a size for it."""
    shares = np.array([_KIND_SHARES[_KINDS.index(label)] for label in among])
    label = among[int(rng.choice(len(among), p=shares / shares.sum()))]
    mean, spread = _SIZES[label]
    length, width, height = np.array(mean) + np.clip(rng.standard_normal(3), -2.0, 2.0) * spread
    return label, (float(length), float(width), float(height))


def _along_path(travelled: FloatArray, lateral: float, turn: int) -> FloatArray:
    """(T, 3) x, y, yaw on the path of a vehicle that comes from the west: straight, a quarter circle, straight."""
    before = travelled - (_APPROACH - _JUNCTION_HALF)  # path length since the entry of the junction
    x, y, yaw = before - _JUNCTION_HALF, np.full_like(before, -lateral), np.zeros_like(before)
    if turn == _STRAIGHT:
        return np.column_stack([x, y, yaw])
    radius = _JUNCTION_HALF + turn * lateral  # the arc ends on the same lane of the arm it turns into
    angle = np.clip(before / radius, 0.0, math.pi / 2.0)
    after = np.maximum(before - radius * math.pi / 2.0, 0.0)
    x = np.where(before > 0.0, -_JUNCTION_HALF + radius * np.sin(angle), x)
    y = -lateral + turn * (radius * (1.0 - np.cos(angle)) + after)
    return np.column_stack([x, y, turn * angle])


def _discs(vehicle: Vehicle, times: FloatArray) -> tuple[FloatArray, float]:
    """(T, 5, 2) centres of the discs that cover a footprint over time, and their radius [m]."""
    pose = vehicle.pose(times)
    ahead = np.column_stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])])
    centres = pose[:, None, :2] + (_DISCS * vehicle.size[0])[None, :, None] * ahead[:, None, :]
    # A disc has to reach the corners of its fifth of the footprint.
    radius = math.hypot(vehicle.size[1] / 2.0, 0.105 * vehicle.size[0]) + _CLEARANCE
    return centres, radius


def _touch(a: tuple[FloatArray, float], b: tuple[FloatArray, float]) -> BoolArray:
    """(T,) whether two vehicles touch."""
    between = a[0][:, :, None, :] - b[0][:, None, :, :]
    touching: BoolArray = ((between**2).sum(axis=-1) < (a[1] + b[1]) ** 2).any(axis=(1, 2))
    return touching
