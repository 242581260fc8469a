"""What a registration baseline is told of another agent's cloud: a sample of it that fits a budget of bytes."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from cobevglue.alignment.group import GroupAligner, Observation
from cobevglue.messages import decode_arrays, encode_arrays
from cobevglue.typing import Float32Array, FloatArray, IntArray

__all__ = ["PointAligner", "height_above_ground", "one_per_voxel", "within_reach"]

MIN_BUDGET = 256
"""Bytes in which a claimed pose and no points at all fit."""
_UNIT = 0.01
"""Coordinates travel as whole centimetres in int16 …"""
_REACH = 300.0
"""… and so cannot be farther than 327 m."""
_STREAM = 70

_GROUND_RADIUS, _GROUND_BIN, _GROUND_TOLERANCES, _FEWEST_ON_GROUND = 40.0, 0.2, (1.0, 0.7, 0.5, 0.3, 0.2), 10


class PointAligner(GroupAligner):
    """Aligns by points. Those of another agent arrive sampled, so that its messages fit the budget.

    The sender takes what the method looks at (`sketch`: one point per voxel), and of that as many as fit, drawn evenly
    and the same ones every time. They travel as int16 centimetres. What arrives as `Observation.points` is the sketch,
    (n, 2) or (n, 3), in place of the cloud, (N, 4), and is told from it by that; the ego's own cloud is not sampled
    further.

    Args:
        budget_bytes: of all that an agent sends for alignment in a frame, a claimed pose included; None for no limit.

    Raises:
        ValueError: a budget of less than 256 bytes.
    """

    def __init__(self, budget_bytes: int | None = None) -> None:
        if budget_bytes is not None and budget_bytes < MIN_BUDGET:
            raise ValueError(f"budget_bytes must be at least {MIN_BUDGET} or None, got {budget_bytes}")
        self.budget_bytes = budget_bytes

    @abstractmethod
    def sketch(self, points: FloatArray) -> FloatArray:
        """What the method looks at of a cloud.

        Args:
            points: (N, 3) finite and within reach, in the agent's LiDAR frame [m].

        Returns:
            (n, D) points, D = 2 or 3, in that frame.
        """

    def sketch_of(self, observation: Observation) -> FloatArray:
        """(n, D) the sketch of an observation, made here unless it is what arrived."""
        points = observation.points
        assert points is not None
        if points.ndim == 2 and points.shape[1] < 4:
            return points.astype(np.float64)
        return self.sketch(within_reach(points))

    def encode(self, agent: str, observation: Observation, time: float, frame: int) -> dict[str, bytes]:
        """The messages of an agent, of at most `budget_bytes` together."""
        parts = super().encode(agent, replace(observation, points=None), time, frame)
        points = np.round(self.sketch_of(observation) / _UNIT).astype(np.int16)
        if self.budget_bytes is not None:
            spent = sum(map(len, parts.values())) + len(encode_arrays({"points": points[:0]}))
            count = max(0, self.budget_bytes - spent) // points[:1].nbytes if len(points) else 0
            if count < len(points):
                rng = np.random.default_rng([0, _STREAM, frame])
                points = points[np.sort(rng.choice(len(points), count, replace=False))]
        return {**parts, "points": encode_arrays({"points": points})}

    def decode(self, parts: Mapping[str, bytes], observation: Observation) -> Observation:
        """What the ego reads in them: the sampled sketch [m] in place of the points."""
        others = {name: data for name, data in parts.items() if name != "points"}
        points = decode_arrays(parts["points"])["points"] * np.float32(_UNIT)
        return replace(super().decode(others, observation), points=points)


def within_reach(points: Float32Array | FloatArray) -> FloatArray:
    """(N, 3) x, y, z of those points (…, at least 3) that are finite and near enough to be sent."""
    xyz = points[:, :3].astype(np.float64)
    return xyz[(np.abs(xyz) < _REACH).all(axis=1)]


def one_per_voxel(points: FloatArray, size: float) -> IntArray:
    """Rows of (N, D) points, one for each voxel of this size [m] that has any: the first; in ascending order."""
    if not len(points):
        return np.zeros(0, np.int64)
    cell = np.floor(points / size).astype(np.int64)
    cell -= cell.min(axis=0)
    key = np.ravel_multi_index(tuple(cell.T), tuple(cell.max(axis=0) + 1))
    return np.sort(np.unique(key, return_index=True)[1])


def height_above_ground(points: FloatArray) -> FloatArray:
    """(N,) heights above the ground [m], taken to be a plane.

    The plane starts level at the height that most points within 40 m have and is fitted to the points near it, five
    times; so it leans as the sensor does. A cloud without ground gives heights above whatever most of it lies on.

    Args:
        points: (N, 3) x, y, z [m].
    """
    x, y, z = points.T
    near = np.hypot(x, y) < _GROUND_RADIUS
    if near.sum() < _FEWEST_ON_GROUND:
        above_lowest: FloatArray = z - z.min(initial=np.inf)
        return above_lowest
    level = np.floor(z[near] / _GROUND_BIN).astype(np.int64)
    values, counts = np.unique(level, return_counts=True)
    basis = np.column_stack([x, y, np.ones_like(x)])
    plane = np.array([0.0, 0.0, (values[counts.argmax()] + 0.5) * _GROUND_BIN])
    for tolerance in _GROUND_TOLERANCES:
        ground = near & (np.abs(z - basis @ plane) < tolerance)
        if ground.sum() < _FEWEST_ON_GROUND:
            break
        plane = np.linalg.lstsq(basis[ground], z[ground], rcond=None)[0]
    heights: FloatArray = z - basis @ plane
    return heights
