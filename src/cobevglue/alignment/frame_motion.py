"""The motion of an agent's frame and of the objects in it, followed through the lists of boxes that the agent sends."""

from __future__ import annotations

import math
from importlib import import_module
from types import ModuleType

import numpy as np

from cobevglue.clock import SHORTEST_STEP
from cobevglue.se2 import SE2
from cobevglue.typing import FloatArray, IntArray

__all__ = ["FrameMotion"]

_SHRINKAGE = 9.0
"""A speed over ground below the root of this many variances counts as 0."""
_TURN_RATE_STD = 0.015
"""Error of the turn rate beyond its variance [rad/s]."""
_FEWEST_TRACKS = 6
"""Tracks that it takes to measure the turn rate."""
_MEMORY = 3.0
"""Time over which the speeds of the frame are averaged [s]."""
_MEASURED = 1.0
"""A velocity of the frame with a larger variance does not enter the average [m^2/s^2]."""
_LEAST_SPEED = 0.5
"""Mean speed of a vehicle that drives [m/s]."""
_SENSOR_RANGE = 150.0
"""The origin of a frame is no sensor if the centre of the boxes is farther away than this [m]."""
_SIDEWAYS_SHARE, _SIDEWAYS_SPEED = 0.1, 0.5
"""A vehicle is not faster sideways than this share of its speed and this [m/s]; twice as much to be none any more."""


class FrameMotion:
    """Velocities of an agent's boxes in its own, moving frame, and the motion of that frame.

    The frame of a sensor on a vehicle is as old as the list: between the list's instant and another one it moves, and
    with it all boxes. Other frames, of a map or of another agent, are taken to be the same at both instants: then only
    the objects move. A frame that moves forwards along its x axis, as vehicles do, is taken for a sensor's.

    Attributes:
        twist: (3,) velocity of a point at rest at the frame's origin, and its turn rate [m/s, m/s, rad/s].
        twist_variance: (3,) its variances.
        is_vehicle: whether the frame moves like a vehicle, or is known to be a vehicle's.
    """

    def __init__(self) -> None:
        track_motion: ModuleType = import_module("cobevglue.alignment.track_motion")  # untyped, as all kernels

        self._follow = track_motion.follow_tracks
        self._noise = track_motion.TrackNoise()
        self._tracks = np.zeros(0, track_motion.TRACK)
        self._velocities: FloatArray = np.zeros((0, 2))
        self.twist = np.zeros(3)
        self.twist_variance = np.array([self._noise.frame_speed**2] * 2 + [self._noise.frame_turn**2])
        self.is_vehicle = False
        self._mean_squares = np.zeros(3)  # of the speed forwards, with its sign, of that sideways, and their weight

    def velocities(self, rows: FloatArray, ids: IntArray, dt: float, is_vehicle: bool = False) -> FloatArray:
        """(N, 2) velocities of the boxes along the axes of the frame [m/s], from this list and all before.

        Moved back by them, boxes are where they would have been detected before, from where the frame was then.

        Args:
            rows: (N, >= 5) boxes in the agent's frame.
            ids: (N,) track ids; without ids, (0,), nothing is known of any velocity.
            dt: time since the last list [s]; a list that is no later is the last one again.
            is_vehicle: the frame is known to be a vehicle's.
        """
        if dt < SHORTEST_STEP:
            return self._velocities if len(self._velocities) == len(rows) else np.zeros((len(rows), 2))
        self._tracks, self.twist, self.twist_variance, motion = self._follow(
            self._tracks, self.twist, self.twist_variance, rows, ids, dt, self._noise
        )
        self.is_vehicle = is_vehicle or (self._drives(dt) and self._looks_around(rows))
        squared = (motion[:, :2] ** 2).sum(axis=1)
        # Shrunk towards 0 by their uncertainty, so that the noise of what stands still does not count as motion.
        over_ground: FloatArray = motion[:, :2] * np.maximum(
            0.0, 1.0 - _SHRINKAGE * motion[:, 2:] / (squared[:, None] + 1e-9)
        )
        if not self.is_vehicle:
            self._velocities = over_ground
            return over_ground
        of_ground = self.twist[:2] + self.twist[2] * np.column_stack([-rows[:, 1], rows[:, 0]])
        self._velocities = over_ground + of_ground
        return self._velocities

    def _drives(self, dt: float) -> bool:
        """Whether the frame has moved forwards along its x axis during the last seconds."""
        if self.twist_variance[:2].max() < _MEASURED:
            share = 1.0 - math.exp(-dt / _MEMORY)
            forwards, sideways = -self.twist[0], self.twist[1]
            self._mean_squares += share * (np.array([forwards * abs(forwards), sideways**2, 1.0]) - self._mean_squares)
        if self._mean_squares[2] == 0.0:
            return False
        forwards, sideways = np.sqrt(np.maximum(self._mean_squares[:2] / self._mean_squares[2], 0.0))
        slack = 2.0 if self.is_vehicle else 1.0
        limit = _SIDEWAYS_SHARE * forwards + _SIDEWAYS_SPEED
        return bool(forwards > _LEAST_SPEED / slack and sideways < slack * limit)

    @staticmethod
    def _looks_around(rows: FloatArray) -> bool:
        """Whether a sensor at the origin could see the boxes."""
        return not len(rows) or math.hypot(*rows[:, :2].mean(axis=0)) < _SENSOR_RANGE

    @property
    def turn_rate_variance(self) -> float:
        """Variance of the turn rate [rad^2/s^2]; infinite while there are too few tracks."""
        if len(self._tracks) < _FEWEST_TRACKS:
            return math.inf
        return float(self.twist_variance[2]) + _TURN_RATE_STD**2

    def before(self, offset: float) -> SE2:
        """now_SE2_before: the frame `offset` seconds ago, in the frame of the last list."""
        shift = offset * self.twist
        half = SE2(0.0, 0.0, 0.5 * shift[2]).rotation @ shift[:2]
        return SE2(half[0], half[1], shift[2])
