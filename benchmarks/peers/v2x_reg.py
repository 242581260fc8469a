"""V2X-Reg++'s matcher: each pair of boxes defines a pose, and the pairs whose poses align many boxes are selected.

Qu et al., "V2I-Calib++: An Online Spatial Calibration Approach for Multi-end LiDAR in Urban Intersections"
(arXiv:2410.11008, later named V2X-Reg++), after "V2I-Calib" (IROS 2024, arXiv:2407.10195): the association of objects
by the overall distance (oDist), the affinity matrix with an assignment over it, and the weighted SVD. The
implementation follows the abstract and a description of the released code; the equations were not available.

As described: each pair of boxes of one class defines the pose that aligns their corners, including the heading. All
other boxes are transformed by this pose and assigned by centre distance and by mean corner distance; assignments below
a threshold are counted. The affinity of the pair is the mean of the two counts minus one. The assignment with the
largest total affinity is computed; pairs below a threshold are dropped, and while the best affinity is small only the
best pairs are kept. The pose is computed by weighted SVD over all corners of the remaining pairs.

Our choices and omissions:

- Bird's-eye view only: four corners, SE(2).
- Boxes that are too far apart are excluded before the assignment instead of after it.
- Headings reversed by pi (an option of the released code): every pair is also tested with the heading rotated by pi,
  and corners are compared in both orders.
- One threshold for all classes, since the lists of the benchmark have only one.

The defaults are the best of `PYTHONPATH=benchmarks python -m peers.search V2XReg` (see `peers/search.py`), 2026-11-27.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment

from cobevglue.alignment import Alignment
from cobevglue.alignment.procrustes import procrustes
from cobevglue.boxes import Boxes
from cobevglue.se2 import SE2
from cobevglue.typing import BoolArray, FloatArray, IntArray
from peers.single_frame import SingleFrameMatcher, same_class

__all__ = ["V2XReg"]


@dataclass
class V2XReg(SingleFrameMatcher):
    """V2X-Reg++ in SE(2).

    Attributes:
        max_boxes: maximum number of boxes of each agent, of which the largest are used; 10 to 25 in the paper.
        distance: maximum centre distance, and mean corner distance, of boxes that agree [m]; 1 for cars in the paper.
        min_affinity: pairs with a lower affinity are dropped; 4 in the released code. The pose is refused if no pair
            remains.
        few: if the best affinity is at most this, only pairs with the best affinity are kept; 5 in the released code.
        half_turns: whether headings may be reversed by pi.
    """

    max_boxes: int = 40
    distance: float = 1.0
    min_affinity: float = 1.0
    few: float = 10.0
    half_turns: bool = False

    @classmethod
    def published(cls) -> V2XReg:
        """Return V2X-Reg++ with the settings of the paper and its released code."""
        return cls(max_boxes=25, distance=1.0, min_affinity=4.0, few=5.0, half_turns=False)

    def match(self, ego: Boxes, other: Boxes) -> Alignment:
        """Estimate the pose from the pairs with the largest affinities."""
        ego_rows, other_rows = (_largest(boxes, self.max_boxes) for boxes in (ego, other))
        ego, other = ego[ego_rows], other[other_rows]
        affinity, turned = self._affinities(ego, other)
        rows, columns = linear_sum_assignment(affinity, maximize=True)
        values = affinity[rows, columns]
        best = values.max()
        if best < self.min_affinity:
            return Alignment.refused(f"the largest affinity is {best:.1f}, {self.min_affinity:.1f} is needed")
        kept = values >= (best if best <= self.few else self.min_affinity)
        rows, columns, values = rows[kept], columns[kept], values[kept]
        first = int(values.argmax())
        i, j = rows[first], columns[first]
        seed = _pose_of_pair(ego, other, i, j, bool(turned[i, j]))
        matches = np.column_stack([ego_rows[rows], other_rows[columns]])
        # Affinities are multiples of one half: twice the affinity is an integer weight in the least squares.
        weights = np.maximum(np.round(2.0 * values).astype(np.int64), 1)
        return Alignment(_pose_of_corners(ego[rows], other[columns], seed, weights), matches)

    def _affinities(self, ego: Boxes, other: Boxes) -> tuple[FloatArray, BoolArray]:
        """Return (M, N) affinities, and whether the better pose is the one with the heading rotated by pi."""
        same = same_class(ego, other)
        affinity: FloatArray = np.full(same.shape, -1.0)
        turned: BoolArray = np.zeros(same.shape, np.bool_)
        ego_points, other_points = _points(ego), _points(other)
        for i, j in np.argwhere(same):
            for turn in (False, True)[: 1 + self.half_turns]:
                moved = _pose_of_pair(ego, other, i, j, turn).apply(other_points)
                value = self._agreeing(ego_points, moved, same) - 1.0
                if value > affinity[i, j]:
                    affinity[i, j], turned[i, j] = value, turn
        return affinity, turned

    def _agreeing(self, ego: FloatArray, moved: FloatArray, same: BoolArray) -> float:
        """Return the number of one-to-one matches: mean of the counts by centres and by corners.

        Args:
            ego: (M, 5, 2) centre and corners of the ego's boxes.
            moved: (N, 5, 2) centre and corners of the other's boxes, in the same frame.
            same: (M, N) whether two boxes are of one class.
        """
        centers = np.linalg.norm(ego[:, None, 0] - moved[None, :, 0], axis=2)
        centers[~same] = np.inf
        near = np.argwhere(centers <= self.distance)
        if len(near) <= 1:
            return float(len(near))
        # The centre of a box is the mean of its corners: the centre distance is at most the mean corner distance.
        corners = np.full(same.shape, np.inf)
        a, b = ego[near[:, 0], 1:], moved[near[:, 1], 1:]
        gap = np.linalg.norm(a - b, axis=2).mean(axis=1)
        if self.half_turns:
            gap = np.minimum(gap, np.linalg.norm(a - np.roll(b, 2, axis=1), axis=2).mean(axis=1))
        corners[near[:, 0], near[:, 1]] = gap
        return (_assigned(centers, self.distance) + _assigned(corners, self.distance)) / 2.0


def _points(boxes: Boxes) -> FloatArray:
    """Return (N, 5, 2) centre and corners of each box [m]."""
    return np.concatenate([boxes.center[:, None, :2], boxes.bev_corners()], axis=1)


def _assigned(gap: FloatArray, limit: float) -> int:
    """Return the largest one-to-one set of pairs within a limit."""
    rows, columns = linear_sum_assignment(np.where(gap <= limit, gap, 1e3 * limit))
    return int((gap[rows, columns] <= limit).sum())


def _largest(boxes: Boxes, count: int) -> IntArray:
    """Return the rows of the boxes with the largest footprints, in ascending order."""
    rows: IntArray = np.sort(np.argsort(-boxes.size[:, 0] * boxes.size[:, 1], kind="stable")[:count])
    return rows


def _pose_of_pair(ego: Boxes, other: Boxes, i: int, j: int, turned: bool) -> SE2:
    """Return the pose that aligns box j of other with box i of ego, with equal or opposite headings."""
    ego_SE2_box = SE2(ego.center[i, 0], ego.center[i, 1], ego.yaw[i] + math.pi * turned)
    other_SE2_box = SE2(other.center[j, 0], other.center[j, 1], other.yaw[j])
    return ego_SE2_box @ other_SE2_box.inverse()


def _pose_of_corners(ego: Boxes, other: Boxes, seed: SE2, weights: IntArray) -> SE2:
    """Estimate the weighted least-squares pose of the corners of K matched boxes.

    Args:
        ego: K boxes.
        other: K boxes.
        seed: a pose near the result, which determines the corner order of boxes with reversed headings.
        weights: (K,) integer weights of the boxes.
    """
    a, b = ego.bev_corners(), other.bev_corners()
    moved = seed.apply(b)
    reverse = np.roll(moved, 2, axis=1)
    turned = np.linalg.norm(a - reverse, axis=2).sum(axis=1) < np.linalg.norm(a - moved, axis=2).sum(axis=1)
    b = np.where(turned[:, None, None], np.roll(b, 2, axis=1), b)
    return procrustes(np.repeat(a, weights, axis=0).reshape(-1, 2), np.repeat(b, weights, axis=0).reshape(-1, 2))
