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


class FrameMotion:
    """Velocities of an agent's boxes in its own, moving frame, and the motion of that frame.

    Attributes:
        twist: (3,) velocity of a point at rest at the frame's origin, and its turn rate [m/s, m/s, rad/s].
        twist_variance: (3,) its variances.
    """

    def __init__(self) -> None:
        track_motion: ModuleType = import_module("cobevglue.alignment.track_motion")  # untyped, as all kernels

        self._follow = track_motion.follow_tracks
        self._noise = track_motion.TrackNoise()
        self._tracks = np.zeros(0, track_motion.TRACK)
        self._velocities: FloatArray = np.zeros((0, 2))
        self.twist = np.zeros(3)
        self.twist_variance = np.array([self._noise.frame_speed**2] * 2 + [self._noise.frame_turn**2])

    def velocities(self, rows: FloatArray, ids: IntArray, dt: float) -> FloatArray:
        """(N, 2) velocities of the boxes along the axes of the frame [m/s], from this list and all before.

        Moved back by them, boxes are where they would have been detected before, from where the frame was then.

        Args:
            rows: (N, >= 5) boxes in the agent's frame.
            ids: (N,) track ids; without ids, (0,), nothing is known of any velocity.
            dt: time since the last list [s]; a list that is no later is the last one again.
        """
        if dt < SHORTEST_STEP:
            return self._velocities if len(self._velocities) == len(rows) else np.zeros((len(rows), 2))
        self._tracks, self.twist, self.twist_variance, motion = self._follow(
            self._tracks, self.twist, self.twist_variance, rows, ids, dt, self._noise
        )
        squared = (motion[:, :2] ** 2).sum(axis=1)
        # Shrunk towards 0 by their uncertainty, so that the noise of what stands still does not count as motion.
        over_ground = motion[:, :2] * np.maximum(0.0, 1.0 - _SHRINKAGE * motion[:, 2:] / (squared[:, None] + 1e-9))
        of_ground = self.twist[:2] + self.twist[2] * np.column_stack([-rows[:, 1], rows[:, 0]])
        self._velocities = over_ground + of_ground
        return self._velocities

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
