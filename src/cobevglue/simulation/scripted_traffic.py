"""Vehicles on scripted paths, with poses in closed form: paths, motions along them, and placement without collisions.

Vehicles do not react to each other; one that would touch another at any time of the scene is not placed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.typing import BoolArray, FloatArray

__all__ = [
    "LIDAR_HEIGHT",
    "Cruise",
    "Departure",
    "Motion",
    "Path",
    "Placement",
    "Traffic",
    "Vehicle",
    "mean_size",
    "random_kind",
    "stationary",
]

LIDAR_HEIGHT = 1.9
"""Height of every vehicle's LiDAR above the ground [m]; also the height of the world's z = 0."""

_SIZES = {  # label; mean and standard deviation of length, width, height [m]
    "car": ("car", (4.5, 1.85, 1.55), (0.3, 0.07, 0.08)),
    "van": ("van", (5.4, 2.0, 2.2), (0.4, 0.06, 0.2)),
    "truck": ("truck", (8.5, 2.5, 3.2), (0.9, 0.04, 0.25)),
    "bus": ("bus", (11.9, 2.55, 3.1), (0.4, 0.02, 0.1)),
    "semitrailer": ("truck", (16.2, 2.55, 3.9), (0.3, 0.02, 0.1)),
}
_CLEARANCE = 0.25  # added to the radius of each vehicle's discs [m]
_CHECK_STEP = 0.1  # time step of the collision check [s]
_DISC_SPACING = 2.6  # at most this length of a footprint to a disc [m]
_LEAST_DISCS = 5
_TRANSITION_PIECES = 8  # pieces of constant curvature that approximate a change of curvature


@dataclass(frozen=True)
class Path:
    """A line of segments of constant curvature that continue each other without a kink.

    Attributes:
        start: x, y [m] and heading [rad] at path length 0, in the world frame.
        segments: length [m] and curvature [1/m] of each, positive to the left. The first also extends backwards and
            the last one forwards without end.
    """

    start: tuple[float, float, float]
    segments: tuple[tuple[float, float], ...]

    def at(self, travelled: FloatArray) -> FloatArray:
        """(T, 3) x, y [m] and heading [rad] at path lengths (T,) [m]."""
        begins, poses, curvature = self._joints
        segment = np.clip(np.searchsorted(begins, travelled, side="right") - 1, 0, len(begins) - 1)
        return _along_arc(poses[segment], curvature[segment], travelled - begins[segment])

    def smoothed(self, transition: float) -> Path:
        """This path with the curvature changing over `transition` [m] instead of at once: a clothoid, in short arcs.

        The headings before and after a transition stay as they are; what follows shifts by some centimetres.

        Raises:
            ValueError: a segment is too short for its transitions.
        """
        half = transition / 2.0
        last = len(self.segments) - 1
        eased: list[tuple[float, float]] = []
        for i, (length, curvature) in enumerate(self.segments):
            before, after = (half if i > 0 else 0.0), (half if i < last else 0.0)
            if length <= before + after and i < last:
                raise ValueError(f"segment {i} is {length:.2f} m long, too short for transitions of {transition} m")
            eased.append((length - before - after, curvature))
            if i < last:
                step = (np.arange(_TRANSITION_PIECES) + 0.5) / _TRANSITION_PIECES
                between = curvature + step * (self.segments[i + 1][1] - curvature)
                eased += [(transition / _TRANSITION_PIECES, float(k)) for k in between]
        return Path(self.start, tuple(eased))

    @cached_property
    def _joints(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Path length (S,) and pose (S, 3) where each segment begins, and its curvature (S,)."""
        length, curvature = np.array(self.segments).T
        begins = np.concatenate([[0.0], np.cumsum(length[:-1])])
        poses = [np.array(self.start)]
        for i in range(len(length) - 1):
            poses.append(_along_arc(poses[-1][None], curvature[i : i + 1], length[i : i + 1])[0])
        return begins, np.array(poses), curvature


def _along_arc(pose: FloatArray, curvature: FloatArray, length: FloatArray) -> FloatArray:
    """(T, 3) poses after `length` (T,) [m] on arcs of `curvature` (T,) [1/m] that start at `pose` (T, 3)."""
    turned = curvature * length
    chord = length * np.sinc(turned / (2.0 * math.pi))
    heading = pose[:, 2] + turned / 2.0
    return np.column_stack(
        [pose[:, 0] + chord * np.cos(heading), pose[:, 1] + chord * np.sin(heading), pose[:, 2] + turned]
    )


class Motion(Protocol):
    """How far a vehicle is along its path over time."""

    @property
    def speed(self) -> float:
        """Mean speed [m/s]; 0 for a vehicle that never moves."""
        ...

    def travelled(self, time: FloatArray) -> FloatArray:
        """Path length (T,) [m] at times (T,) [s]."""
        ...


@dataclass(frozen=True, slots=True)
class Cruise:
    """A speed that oscillates around its mean.

    A vehicle that follows another repeats its oscillation a reaction time later (Newell, "A simplified car-following
    theory", 2002): the same mean speed, swing and period, and a later phase.

    Attributes:
        start: path length at time 0 [m].
        speed: mean speed [m/s]; 0 for a stationary vehicle.
        swing: relative amplitude of the oscillation, below 1.
        period: of the oscillation [s].
        phase: of the oscillation at time 0 [rad].
    """

    start: float
    speed: float
    swing: float = 0.0
    period: float = 8.0
    phase: float = 0.0

    def travelled(self, time: FloatArray) -> FloatArray:
        """Path length at `time` [m]: the integral of `speed * (1 + swing * cos(...))`."""
        rate = 2.0 * math.pi / self.period
        wave: FloatArray = np.sin(rate * time + self.phase) - math.sin(self.phase)
        return self.start + self.speed * (time + self.swing / rate * wave)


@dataclass(frozen=True, slots=True)
class Departure:
    """A vehicle that stands and then drives off.

    Attributes:
        start: path length where it stands [m].
        time: when it starts to move [s].
        speed: that it reaches [m/s].
        duration: of the acceleration, which begins and ends smoothly [s].
    """

    start: float
    time: float
    speed: float
    duration: float

    def travelled(self, time: FloatArray) -> FloatArray:
        """Path length at `time` [m]: the integral of `speed * (3 u^2 - 2 u^3)`, u from 0 to 1 over the duration."""
        since = np.maximum(time - self.time, 0.0)
        u = np.minimum(since / self.duration, 1.0)
        return self.start + self.speed * (self.duration * (u**3 - u**4 / 2.0) + np.maximum(since - self.duration, 0.0))


@dataclass(frozen=True, slots=True)
class Vehicle:
    """One vehicle, its path and its motion along the path.

    Attributes:
        label: "car", "van", "truck" or "bus".
        size: length, width, height [m].
        path: of its centre.
        motion: along the path.
        skew: constant deviation of the heading from the path [rad], as of parked cars.
    """

    label: str
    size: tuple[float, float, float]
    path: Path
    motion: Motion
    skew: float = 0.0

    def pose(self, time: FloatArray) -> FloatArray:
        """(T, 3) x, y [m] and yaw [rad] in the world frame at times (T,) [s]."""
        return self.path.at(self.motion.travelled(time)) + [0.0, 0.0, self.skew]


def stationary(label: str, size: tuple[float, float, float], x: float, y: float, yaw: float) -> Vehicle:
    """A vehicle that stands at this pose of the world frame [m, m, rad]."""
    return Vehicle(label, size, Path((x, y, yaw), ((1.0, 0.0),)), Cruise(0.0, 0.0))


@dataclass(frozen=True)
class Traffic:
    """All vehicles of a scene.

    Attributes:
        vehicles: the vehicles; the index is the object id.
    """

    vehicles: tuple[Vehicle, ...]

    def at(self, time: float) -> Boxes:
        """All vehicles in the world frame at `time` [s], with track ids (object ids) and labels."""
        poses, size = self._first_poses.copy(), np.array([vehicle.size for vehicle in self.vehicles])
        for i, vehicle in enumerate(self.vehicles):
            if vehicle.motion.speed > 0.0:
                poses[i] = vehicle.pose(np.array([time]))[0]
        return Boxes(
            center=np.column_stack([poses[:, :2], size[:, 2] / 2.0 - LIDAR_HEIGHT]),
            size=size,
            yaw=poses[:, 2],
            track_id=np.arange(len(self.vehicles)),
            label=[vehicle.label for vehicle in self.vehicles],
        )

    @cached_property
    def _first_poses(self) -> FloatArray:
        """(N, 3) poses at time 0."""
        return np.concatenate([vehicle.pose(np.zeros(1)) for vehicle in self.vehicles])


class Placement:
    """Vehicles placed one after another, none of which touches another at any time of the scene.

    Args:
        duration: of the scene [s].

    Attributes:
        vehicles: those placed so far.
    """

    def __init__(self, duration: float) -> None:
        self.vehicles: list[Vehicle] = []
        self._times = np.arange(0.0, duration + _CHECK_STEP, _CHECK_STEP)
        self._discs: list[tuple[FloatArray, float]] = []

    def add(self, vehicle: Vehicle) -> bool:
        """Place this vehicle unless it would touch another one; whether it was placed."""
        covered = _discs(vehicle, self._times)
        if any(_touch(covered, other).any() for other in self._discs):
            return False
        self.add_unchecked(vehicle)
        return True

    def add_unchecked(self, vehicle: Vehicle) -> None:
        """Place this vehicle, which is known to touch none."""
        self.vehicles.append(vehicle)
        self._discs.append(_discs(vehicle, self._times))


def mean_size(kind: str) -> tuple[float, float, float]:
    """Mean length, width and height of a kind of vehicle [m]."""
    return _SIZES[kind][1]


def random_kind(rng: np.random.Generator, shares: Mapping[str, float]) -> tuple[str, tuple[float, float, float]]:
    """A random label, drawn by the shares of the kinds, and a random size [m]."""
    share = np.array(list(shares.values()))
    label, mean, spread = _SIZES[list(shares)[int(rng.choice(len(share), p=share / share.sum()))]]
    length, width, height = np.array(mean) + np.clip(rng.standard_normal(3), -2.0, 2.0) * spread
    return label, (float(length), float(width), float(height))


def _discs(vehicle: Vehicle, times: FloatArray) -> tuple[FloatArray, float]:
    """(T, D, 2) centres of the discs that cover a footprint over time, and their radius [m]."""
    pose = vehicle.pose(times)
    length, width, _ = vehicle.size
    ahead = np.column_stack([np.cos(pose[:, 2]), np.sin(pose[:, 2])])
    n = max(_LEAST_DISCS, math.ceil(length / _DISC_SPACING))
    # Each disc covers the corners of its part of the footprint, which overlaps with the next one.
    reach = 0.525 / n
    along = np.linspace(-0.5 + 0.4 / n, 0.5 - 0.4 / n, n) * length
    centres = pose[:, None, :2] + along[None, :, None] * ahead[:, None, :]
    return centres, math.hypot(width / 2.0, reach * length) + _CLEARANCE


def _touch(a: tuple[FloatArray, float], b: tuple[FloatArray, float]) -> BoolArray:
    """(T,) whether two vehicles touch."""
    between = a[0][:, :, None, :] - b[0][:, None, :, :]
    touching: BoolArray = ((between**2).sum(axis=-1) < (a[1] + b[1]) ** 2).any(axis=(1, 2))
    return touching
