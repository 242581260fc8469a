"""Vehicles on scripted paths over a four-arm junction, with poses in closed form.

The junction is at the world's origin with arms to the east, north, west and south, two lanes per direction, and
right-hand traffic. East and west have green: their vehicles drive. South and north have red: vehicles queue on the
inner lane, and the outer one is free for turning right. Other vehicles are parked beside the road. Vehicles do not
react to each other; one that would touch another at any time of the scene is not placed.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.typing import BoolArray, FloatArray

__all__ = ["LIDAR_HEIGHT", "Traffic", "Vehicle", "place_traffic"]

LIDAR_HEIGHT = 1.9
"""Height of every agent's LiDAR above the ground [m]; also the height of the world's z = 0."""

_INNER_LANE, _OUTER_LANE, _PARKING = 1.75, 5.25, 8.6  # offsets to the right of the road's centre line [m]
_JUNCTION_HALF = 14.0  # from the junction's centre to the start of turning arcs [m]
_STOP_LINE = 17.0  # from the centre to the first queueing vehicle [m]
_APPROACH = 110.0  # from the start of a path (s = 0) to the centre [m]
_WEST, _SOUTH, _EAST, _NORTH = 0, 1, 2, 3  # arms, by the quarter turns from "coming from the west, driving east"
_STRAIGHT, _LEFT, _RIGHT = 0, 1, -1

_KINDS = ("car", "van", "truck", "bus")
_KIND_SHARES = (0.7, 0.14, 0.08, 0.08)
_SIZES = {  # mean and standard deviation of length, width, height [m]
    "car": ((4.5, 1.85, 1.55), (0.3, 0.07, 0.08)),
    "van": ((5.4, 2.0, 2.2), (0.4, 0.06, 0.2)),
    "truck": ((8.5, 2.5, 3.2), (0.9, 0.04, 0.25)),
    "bus": ((11.9, 2.55, 3.1), (0.4, 0.02, 0.1)),
}
_AGENT_STARTS = ((_WEST, _STRAIGHT, 42.0), (_SOUTH, _RIGHT, 38.0), (_EAST, _STRAIGHT, 34.0), (_NORTH, _RIGHT, 32.0))
_AGENT_SPACING = 22.0  # between agents on the same arm [m]
_CLEARANCE = 0.25  # added to the radius of each vehicle's discs [m]
_CHECK_STEP = 0.1  # time step of the collision check [s]
_MAX_FAILURES = 300  # consecutive failures after which the junction is full
_DISCS = np.array([-0.42, -0.21, 0.0, 0.21, 0.42])  # centres of the five discs that cover a footprint, in lengths


@dataclass(frozen=True, slots=True)
class Vehicle:
    """One vehicle and its path.

    Attributes:
        label: "car", "van", "truck" or "bus".
        size: length, width, height [m].
        arm: the arm it comes from, in quarter turns from the west: 0 west, 1 south, 2 east, 3 north.
        lateral: offset of its path to the right of the road's centre line [m].
        turn: 0 straight on, 1 left, -1 right.
        start: path length at time 0 [m]; the junction's centre is at 110 m on a straight path.
        speed: mean speed [m/s]; 0 for a stationary vehicle.
        swing: relative amplitude of the speed's oscillation, below 1.
        period: of the oscillation [s].
        phase: of the oscillation at time 0 [rad].
        skew: constant deviation of the heading from the path [rad], as of parked cars.
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
        """Path length at `time` [m]: the integral of `speed * (1 + swing * cos(...))`."""
        rate = 2.0 * math.pi / self.period
        wave: FloatArray = np.sin(rate * time + self.phase) - math.sin(self.phase)
        return self.start + self.speed * (time + self.swing / rate * wave)

    def pose(self, time: FloatArray) -> FloatArray:
        """(T, 3) x, y [m] and yaw [rad] in the world frame at times (T,) [s]."""
        path = _along_path(self.travelled(time), self.lateral, self.turn)
        turned = self.arm * math.pi / 2.0
        c, s = math.cos(turned), math.sin(turned)
        x, y, yaw = path.T
        return np.column_stack([c * x - s * y, s * x + c * y, yaw + turned + self.skew])


@dataclass(frozen=True, slots=True)
class Traffic:
    """All vehicles of a scene.

    Attributes:
        vehicles: the vehicles, agents first; the index is the object id.
        n_agents: number of agents.
    """

    vehicles: tuple[Vehicle, ...]
    n_agents: int

    def at(self, time: float) -> Boxes:
        """All vehicles in the world frame at `time` [s], with track ids (object ids) and labels."""
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
    """Random traffic at the junction without collisions.

    Args:
        n_vehicles: number of vehicles including agents: about a quarter are parked, a fifth queue, the others drive.
        n_agents: number of agents, at most 8. They come from the west, south, east and north in turn, and drive.
        duration: of the scene [s].
        rng: random generator.

    Raises:
        ValueError: too many vehicles for the junction.
    """
    times = np.arange(0.0, duration + _CHECK_STEP, _CHECK_STEP)
    placed = _agents(n_agents, rng)
    discs = [_discs(vehicle, times) for vehicle in placed]
    failures = 0
    while len(placed) < n_vehicles:
        share = (len(placed) - n_agents) / n_vehicles  # stationary vehicles first: the others are placed around them
        if failures > _MAX_FAILURES / 5:  # no place for this kind of vehicle: try all kinds
            share = rng.random()
        candidate = _parked(rng) if share < 0.27 else _queueing(rng) if share < 0.47 else _driving(rng, duration)
        covered = _discs(candidate, times)
        if any(_touch(covered, other).any() for other in discs):
            failures += 1
            if failures == _MAX_FAILURES:
                raise ValueError(f"the junction has room for {len(placed)} vehicles, {n_vehicles} were requested")
            continue
        failures = 0
        placed.append(candidate)
        discs.append(covered)
    return Traffic(tuple(placed), n_agents)


def _agents(number: int, rng: np.random.Generator) -> list[Vehicle]:
    """Cars that approach the junction; those beyond the fourth follow the first four at their speed."""
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
    """A vehicle that waits at red."""
    label, size = _kind(rng)
    arm = int(rng.choice([_SOUTH, _NORTH]))
    front = _STOP_LINE + rng.uniform(0.0, 40.0)
    skew = rng.normal(0.0, math.radians(0.5))
    return Vehicle(label, size, arm, _INNER_LANE, _STRAIGHT, _APPROACH - front - size[0] / 2.0, 0.0, skew=skew)


def _driving(rng: np.random.Generator, duration: float) -> Vehicle:
    """A vehicle that has green and is near the junction in the middle of the scene."""
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
    """A random label, drawn by the shares of the kinds, and a random size."""
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
    radius = _JUNCTION_HALF + turn * lateral  # the arc ends on the same lane of the exit arm
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
    # Each disc covers the corners of its fifth of the footprint.
    radius = math.hypot(vehicle.size[1] / 2.0, 0.105 * vehicle.size[0]) + _CLEARANCE
    return centres, radius


def _touch(a: tuple[FloatArray, float], b: tuple[FloatArray, float]) -> BoolArray:
    """(T,) whether two vehicles touch."""
    between = a[0][:, :, None, :] - b[0][:, None, :, :]
    touching: BoolArray = ((between**2).sum(axis=-1) < (a[1] + b[1]) ** 2).any(axis=(1, 2))
    return touching
