"""Messages of the registration baselines: a subset of another agent's cloud that fits a budget of bytes."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from cobevglue.alignment.group import GroupAligner, Observation
from cobevglue.messages import decode_arrays, encode_arrays
from cobevglue.typing import Float32Array, FloatArray, IntArray

__all__ = ["PointAligner", "Sketch", "height_above_ground", "one_per_voxel", "within_reach"]

MIN_BUDGET = 256
"""Bytes of a message with a claimed pose and no points, rounded up."""
_UNIT = 0.01
"""Coordinates are transmitted as whole centimetres in int16 …"""
_REACH = 300.0
"""… and so cannot be farther than 327 m."""
_COARSER, _COARSEST = 1.05, 140
"""Ratio of successive grid sizes, and their number: up to a thousandfold."""
_STREAM = 70

_GROUND_RADIUS, _GROUND_BIN, _GROUND_TOLERANCES, _FEWEST_ON_GROUND = 40.0, 0.2, (1.0, 0.7, 0.5, 0.3, 0.2), 10


@dataclass(frozen=True, slots=True, eq=False)
class Sketch(Observation):
    """An observation as it arrives: its `points` are (n, D), sampled, and without intensity.

    Attributes:
        voxel: size of the grid that they were sampled on [m].
    """

    voxel: float = 0.0


class PointAligner(GroupAligner):
    """Aligns by points. Those of another agent arrive sampled, so that its messages fit the budget.

    The sender selects the points that the method uses (`standing`), and of these one per voxel. If they exceed the
    budget, the grid is made coarser, by 5 % each time, as long as it still has as many points as fit; the excess is
    then dropped at random, with a fixed seed. Points are transmitted as int16 centimetres. The ego's own cloud is not
    limited.

    Args:
        budget_bytes: of all that an agent sends for alignment in a frame, a claimed pose included; None for no limit.

    Attributes:
        voxel: size of the finest grid [m].

    Raises:
        ValueError: a budget of less than 256 bytes.
    """

    voxel: ClassVar[float]

    def __init__(self, budget_bytes: int | None = None) -> None:
        if budget_bytes is not None and not budget_bytes >= MIN_BUDGET:
            raise ValueError(f"budget_bytes must be at least {MIN_BUDGET} or None, got {budget_bytes}")
        self.budget_bytes = budget_bytes

    @abstractmethod
    def standing(self, points: FloatArray) -> FloatArray:
        """Select the points of a cloud that the method uses.

        Args:
            points: (N, 3) finite and within reach, in the agent's LiDAR frame [m].

        Returns:
            (n, D) points, D = 2 or 3, in that frame.
        """

    def sketch(self, observation: Observation, voxel: float | None = None) -> Sketch:
        """Return a received sketch unchanged; sample other observations on a grid of this size [m].

        Args:
            observation: of any agent.
            voxel: of the grid; the finest by default.
        """
        if isinstance(observation, Sketch):
            return observation
        voxel = self.voxel if voxel is None else voxel
        points = self._looked_at(observation)
        points = points[one_per_voxel(points, voxel)]
        return Sketch(points=points.astype(np.float32), pose=observation.pose, voxel=voxel)

    def encode(self, agent: str, observation: Observation, time: float, frame: int) -> dict[str, bytes]:
        """The messages of an agent, of at most `budget_bytes` together."""
        parts = super().encode(agent, replace(observation, points=None), time, frame)
        points, level = self._looked_at(observation), 0
        rows = one_per_voxel(points, self.voxel)
        if self.budget_bytes is not None:
            left = self.budget_bytes - sum(map(len, parts.values())) - len(_encode(points[:0], 0))
            most = max(0, left // (2 * points.shape[1]))
            if most < len(rows):
                level = self._coarsest(points, most)
                rows = one_per_voxel(points, self._size(level))
                rng = np.random.default_rng([0, _STREAM, frame])
                rows = np.sort(rng.choice(rows, most, replace=False))
        return {**parts, "points": _encode(points[rows], level)}

    def decode(self, parts: Mapping[str, bytes], observation: Observation) -> Sketch:
        """What the ego reads in them."""
        pose = super().decode({name: data for name, data in parts.items() if name != "points"}, observation).pose
        arrays = decode_arrays(parts["points"])
        points = arrays["points"] * np.float32(_UNIT)
        return Sketch(points=points, pose=pose, voxel=self._size(int(arrays["grid"])))

    def _looked_at(self, observation: Observation) -> FloatArray:
        assert observation.points is not None
        return self.standing(within_reach(observation.points))

    def _coarsest(self, points: FloatArray, least: int) -> int:
        """The coarsest grid with at least so many voxels that have points; 0 is the finest, which has as many."""
        fine, coarse = 0, _COARSEST
        while coarse - fine > 1:
            middle = (fine + coarse) // 2
            enough = len(one_per_voxel(points, self._size(middle))) >= least
            fine, coarse = (middle, coarse) if enough else (fine, middle)
        return fine

    def _size(self, level: int) -> float:
        return self.voxel * _COARSER**level


def _encode(points: FloatArray, level: int) -> bytes:
    centimetres = np.round(points / _UNIT).astype(np.int16)
    return encode_arrays({"points": centimetres, "grid": np.array(level, np.uint8)})


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
