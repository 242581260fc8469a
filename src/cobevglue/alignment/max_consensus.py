"""FPV-RCNN's localisation correction: the shift and turn of the other's boxes that most boxes agree with.

Yuan et al., "Keypoints-Based Deep Feature Fusion for Cooperative Vehicle Detection of Autonomous Driving" (RA-L 2022),
section III: a grid around the claimed relative pose is searched for the maximum consensus, and the boxes that agree
give the pose by least squares. The paper also matches poles, walls and fences, which its network segments; our
detector finds vehicles only, so fewer objects are available.

How far to search and how many have to agree were chosen on simulated drives of the split "validation" (16 frames, three
agents each, this project's detector): with noise of 0.5, 1 and 2.5 (m and degrees, on every agent) 0.92, 0.95 and 0.89
of the relative poses came within 1 m and 1 degree, of the claimed ones 0.52, 0.12 and 0.02. The published code demands
ten that agree, and searches as far as the noise is known to reach.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from cobevglue.alignment.alignment import Alignment
from cobevglue.alignment.given import GivenLocalisation
from cobevglue.alignment.group import GroupAligner, Observation
from cobevglue.alignment.procrustes import procrustes
from cobevglue.se2 import SE2
from cobevglue.typing import FloatArray, IntArray

__all__ = ["MaximumConsensus"]

_STEP, _TURN_STEP = 0.5, math.radians(1.0)
"""Of the search, the paper's [m, rad]."""


class MaximumConsensus(GroupAligner):
    """The claimed poses, each corrected by what most boxes agree with; never refused.

    The other agent is shifted in steps of 0.5 m along the ego's axes and turned about itself in steps of 1 degree. A
    box of its agrees where a box of the ego is within `distance`. Of equally many the closer ones win, then the smaller
    shift. Where fewer than `min_consensus` agree the claimed pose stays (with unknown covariance and no matches).

    Args:
        shift: how far the search goes along each axis, either way [m].
        turn: how far it turns, either way [rad].
        distance: between the centres of boxes that agree [m].
        min_consensus: how many have to agree, one to one.

    Raises:
        ValueError: a setting out of its range.
    """

    needs = frozenset({"boxes", "pose"})

    def __init__(
        self,
        shift: float = 6.0,
        turn: float = math.radians(6.0),
        distance: float = 1.0,
        min_consensus: int = 4,
    ) -> None:
        if not (0.0 <= shift <= 50.0 and 0.0 <= turn <= math.pi):
            raise ValueError(f"shift must be in [0, 50] m and turn in [0, pi] rad, got {shift} and {turn}")
        if not distance > 0.0:
            raise ValueError(f"distance must be > 0, got {distance}")
        if not min_consensus >= 2:
            raise ValueError(f"min_consensus must be >= 2, as fewer give no pose, got {min_consensus}")
        self.distance, self.min_consensus = distance, min_consensus
        count = int(shift / _STEP + 1e-9)
        self._steps = _STEP * np.arange(-count, count + 1)
        shifts = np.stack(np.meshgrid(self._steps, self._steps, indexing="ij"), axis=-1).reshape(-1, 2)
        # The nearest come first, and the first of equally good ones wins.
        self._order = np.argsort(np.hypot(*shifts.T), kind="stable")
        self._shifts = shifts[self._order]
        count = int(turn / _TURN_STEP + 1e-9)
        self._turns = sorted((_TURN_STEP * k for k in range(-count, count + 1)), key=abs)

    def align_group(
        self, ego: str, observations: Mapping[str, Observation], time: float | None = None
    ) -> dict[str, Alignment]:
        """Each collaborator by itself."""
        found = GivenLocalisation().align_group(ego, observations, time)
        own = observations[ego].boxes
        assert own is not None
        for name, claimed in found.items():
            boxes = observations[name].boxes
            assert boxes is not None
            assert claimed.ego_SE2_other is not None
            ego_xy, other_xy = own.center[:, :2], boxes.center[:, :2]
            pose = self._most_agreed(ego_xy, other_xy, claimed.ego_SE2_other)
            matches = mutual_nearest(ego_xy, pose.apply(other_xy), self.distance)
            if len(matches) >= self.min_consensus:
                found[name] = Alignment(procrustes(ego_xy[matches[:, 0]], other_xy[matches[:, 1]]), matches)
        return found

    def _most_agreed(self, ego: FloatArray, other: FloatArray, claimed: SE2) -> SE2:
        """The pose on the grid with the largest consensus between (N, 2) and (M, 2) centres."""
        best, pose = 0.0, claimed
        for turn in self._turns:
            turned = claimed @ SE2(yaw=turn)
            score = self._scores(ego, turned.apply(other))
            if score.max(initial=0.0) > best:
                best = score.max()
                x, y = self._shifts[score.argmax()]
                pose = SE2(x, y) @ turned
        return pose

    def _scores(self, ego: FloatArray, other: FloatArray) -> FloatArray:
        """(S,) for each shift of other's centres how many of them agree; less a share below 1 for their distances."""
        gap = ego[None] - other[:, None]
        reach = self._steps[-1] + self.distance
        rows, columns = np.nonzero((np.abs(gap) <= reach).all(axis=2))
        if not len(rows):
            return np.zeros(len(self._shifts))
        x, y = ((gap[rows, columns, axis][:, None] - self._steps) ** 2 / self.distance**2 for axis in range(2))
        squared = (x[:, :, None] + y[:, None, :]).reshape(len(rows), -1)
        firsts = np.flatnonzero(np.diff(rows, prepend=-1))
        nearest = np.minimum.reduceat(squared, firsts, axis=0)
        scores: FloatArray = np.where(nearest <= 1.0, 1.0 - nearest / (len(firsts) + 1), 0.0).sum(axis=0)
        return scores[self._order]


def mutual_nearest(ego: FloatArray, other: FloatArray, distance: float) -> IntArray:
    """(K, 2) rows of (N, 2) and (M, 2) points that are each other's nearest, and within a distance [m]."""
    if not len(ego) or not len(other):
        return np.zeros((0, 2), np.int64)
    gap = np.hypot(*(ego[:, None] - other[None]).transpose(2, 0, 1))
    rows = np.arange(len(ego))
    columns = gap.argmin(axis=1)
    kept = (gap.argmin(axis=0)[columns] == rows) & (gap[rows, columns] <= distance)
    return np.column_stack([rows[kept], columns[kept]])
