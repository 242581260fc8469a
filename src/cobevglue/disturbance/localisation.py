"""Disturbances of localisation: noise, the same-place attack, replayed and constantly offset poses."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
from pydantic import Field

from cobevglue.disturbance.disturbance import Disturbance, ObservedFrame, agent_rng
from cobevglue.typing import FloatArray

__all__ = ["LocalisationNoise", "OffsetPose", "ReplayedPose", "SamePlace"]

_NOISE_STREAM = 70
_Spread = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
_Finite = Annotated[float, Field(allow_inf_nan=False)]


class LocalisationNoise(Disturbance):
    """Gaussian noise on the pose of every agent, the ego's included, anew in every frame (paper, section 6.2).

    With the same key, noise of different standard deviations has the same draws, scaled.

    Attributes:
        position: standard deviation of x and of y [m].
        yaw: standard deviation of the heading [degrees], as papers give it.
    """

    position: _Spread = 0.5
    yaw: _Spread = 0.5

    def apply(self, frames: Sequence[ObservedFrame], index: int, ego: str, key: Sequence[int]) -> ObservedFrame:
        """Add noise to the claimed pose of every agent."""
        now = frames[index]
        claimed = {}
        for agent, world_SE3_lidar in now.claimed.items():
            x, y, turn = agent_rng(key, _NOISE_STREAM, index, agent).standard_normal(3)
            noisy = _turned(math.radians(self.yaw * turn)) @ world_SE3_lidar
            noisy[:3, 3] = world_SE3_lidar[:3, 3] + (self.position * x, self.position * y, 0.0)
            claimed[agent] = noisy
        return replace(now, claimed=claimed)


class SamePlace(Disturbance):
    """The attack of the paper: spoofed GNSS, with which all collaborators claim the pose of the ego."""

    def apply(self, frames: Sequence[ObservedFrame], index: int, ego: str, key: Sequence[int]) -> ObservedFrame:
        """Replace all claimed poses by the ego's."""
        now = frames[index]
        return replace(now, claimed=dict.fromkeys(now.claimed, now.claimed[ego]))


class ReplayedPose(Disturbance):
    """Replayed GNSS: collaborators claim an earlier pose of their own.

    Attributes:
        seconds: its age [s]. In the first frames of a sequence it is the first pose.
    """

    seconds: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] = 1.0

    def apply(self, frames: Sequence[ObservedFrame], index: int, ego: str, key: Sequence[int]) -> ObservedFrame:
        """Replace the claimed poses of collaborators by earlier ones."""
        now = frames[index]
        claimed = dict(now.claimed)
        for agent in now.collaborators(ego):
            had = [frame for frame in frames[: index + 1] if agent in frame.claimed]
            old = [frame for frame in had if frame.time <= now.time - self.seconds + 1e-6]
            claimed[agent] = (old[-1] if old else had[0]).claimed[agent]
        return replace(now, claimed=claimed)


class OffsetPose(Disturbance):
    """A constant error of the collaborators' poses in their own frames, as of an uncalibrated sensor.

    Attributes:
        x: error forwards [m].
        y: error to the left [m].
        yaw: error of the heading, counter-clockwise [degrees].
    """

    x: _Finite = 3.0
    y: _Finite = -2.0
    yaw: _Finite = 3.0

    def apply(self, frames: Sequence[ObservedFrame], index: int, ego: str, key: Sequence[int]) -> ObservedFrame:
        """Add the error to the claimed poses of collaborators."""
        now = frames[index]
        lidar_SE3_claimed = _turned(math.radians(self.yaw))
        lidar_SE3_claimed[:2, 3] = self.x, self.y
        claimed = {agent: pose if agent == ego else pose @ lidar_SE3_claimed for agent, pose in now.claimed.items()}
        return replace(now, claimed=claimed)


def _turned(yaw: float) -> FloatArray:
    """(4, 4) rotation about z."""
    turn = np.eye(4)
    turn[:2, :2] = [[math.cos(yaw), -math.sin(yaw)], [math.sin(yaw), math.cos(yaw)]]
    return turn
