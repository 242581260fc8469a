"""FreeAlign's matcher: a common subgraph of box distances, grown from several anchors.

Lei et al., "Robust Collaborative Perception without External Localization and Clock Devices" (ICRA 2024,
arXiv:2405.02965). The method section has three parts: salient-object graph learning, multi-anchor subgraph searching
(MASS), and the pose from the matched boxes. This implementation follows the abstract and a description of the released
matcher; the full text was not available, so equation numbers are missing.

As described: nodes are boxes, edges their distances. Every pair of boxes (one of each agent) seeds an anchor set; the
pair whose distances agree best is added while it agrees with *all* anchors; then further pairs that agree with all
anchors within a wider tolerance are added. The set with the lowest (100 + sum of gaps) / size^2 is selected. Fewer than
`min_anchors` anchors or at most `min_anchors` nodes are refused. Headings, sizes and tracks are not used.

Our choices and omissions:

- Edge features are distances. The paper learns them with a graph attention network; the released matcher does not.
- The released matcher estimates a similarity transform, including scale, by RANSAC. Here the pose is rigid: of the
  poses of all pairs of matches, the one with the most inliers, refined by least squares on the inliers. Outliers are
  removed before the check for refusal, so that mirrored sets are refused.
- The search over the collaborator's past lists (time delay) and the learned initial similarity of nodes are omitted.

The defaults are the best of `PYTHONPATH=benchmarks python -m peers.search FreeAlign` (see `peers/search.py`),
2026-11-27.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cobevglue.alignment import Alignment
from cobevglue.boxes import Boxes
from cobevglue.typing import FloatArray, IntArray
from peers.single_frame import SingleFrameMatcher, distances, pose_of_matches

__all__ = ["FreeAlign"]


@dataclass
class FreeAlign(SingleFrameMatcher):
    """FreeAlign without its graph network.

    Attributes:
        anchor_tolerance: maximum difference of two distances between anchors [m]; 0.6 in the released matcher.
        box_tolerance: the same between an anchor and a further node [m]; 0.5 in the released matcher.
        min_anchors: minimum number of anchors; 3 to 5 in the released matcher. More nodes than this are required.
        inlier_distance: maximum residual of an inlier under the pose [m].
    """

    anchor_tolerance: float = 0.6
    box_tolerance: float = 1.5
    min_anchors: int = 2
    inlier_distance: float = 1.0

    @classmethod
    def published(cls) -> FreeAlign:
        """Return FreeAlign with the tolerances of the released matcher; the inlier distance is ours."""
        return cls(anchor_tolerance=0.6, box_tolerance=0.5, min_anchors=3, inlier_distance=2.0)

    def match(self, ego: Boxes, other: Boxes) -> Alignment:
        """Estimate the pose from the best common subgraph."""
        matches = self._common_subgraph(distances(ego), distances(other))
        if len(matches) > self.min_anchors:
            matches = _consensus(ego, other, matches, self.inlier_distance)
        return pose_of_matches(ego, other, matches, self.min_anchors + 1)

    def _common_subgraph(self, ego: FloatArray, other: FloatArray) -> IntArray:
        """Return (K, 2) matches of (M, M) and (N, N) distances; K = 0 if no set has enough anchors."""
        # gap[i, j, m, n]: difference of the distances i-m of ego and j-n of other.
        gap = np.abs(ego[:, None, :, None] - other[None, :, None, :])
        near = gap < max(self.anchor_tolerance, self.box_tolerance)
        largest = np.minimum(near.any(axis=3).sum(axis=2), near.any(axis=2).sum(axis=2))
        best: IntArray = np.zeros((0, 2), np.int64)
        lowest = math.inf
        for seed in np.argsort(-largest, axis=None, kind="stable"):
            i, j = np.unravel_index(seed, largest.shape)
            if largest[i, j] <= self.min_anchors or 100.0 / largest[i, j] ** 2 >= lowest:
                break  # sets from this and all later seeds are too small
            nodes, score = self._grow(gap, int(i), int(j))
            if score < lowest:
                best, lowest = nodes, score
        return best

    def _grow(self, gap: FloatArray, i: int, j: int) -> tuple[IntArray, float]:
        """Return (K, 2) nodes grown from the seed (i, j) and their score, infinite with too few anchors."""
        nodes = [(i, j)]
        total = 0.0
        worst = gap[i, j].copy()  # of each pair, the largest gap to the anchors so far
        worst[i, :] = worst[:, j] = math.inf
        for tolerance, anchors in ((self.anchor_tolerance, True), (self.box_tolerance, False)):
            while worst.min() < tolerance:
                m, n = divmod(int(worst.argmin()), worst.shape[1])
                total += worst[m, n]
                nodes.append((m, n))
                if anchors:
                    np.maximum(worst, gap[m, n], out=worst)
                worst[m, :] = worst[:, n] = math.inf
            if anchors and len(nodes) < self.min_anchors:
                return np.array(nodes), math.inf
        return np.array(nodes), (100.0 + total) / len(nodes) ** 2


def _consensus(ego: Boxes, other: Boxes, matches: IntArray, distance: float) -> IntArray:
    """Return the largest set of matches within `distance` [m] under the pose of two of them."""
    p, q = (b.center[rows, 0] + 1j * b.center[rows, 1] for b, rows in zip((ego, other), matches.T, strict=True))
    a, b = np.triu_indices(len(matches), 1)
    rotation = (p[b] - p[a]) * np.conj(q[b] - q[a])
    rotation /= np.maximum(np.abs(rotation), 1e-12)
    shift = (p[a] + p[b] - rotation * (q[a] + q[b])) / 2.0
    agree = np.abs(p - rotation[:, None] * q - shift[:, None]) < distance
    kept: IntArray = matches[agree[agree.sum(axis=1).argmax()]]
    return kept
