"""VIPS' matcher: spectral graph matching of boxes and their distances and headings.

Shi et al., "VIPS: Real-Time Perception Fusion for Infrastructure-Assisted Autonomous Driving" (MobiCom 2022), the graph
matching part. The text was not at hand while this was written, only a description of an unofficial implementation, so
there are no equation numbers.

As described: a matrix holds the affinities of all pairs of boxes (one of each agent), on the diagonal those of nodes,
off it those of edges, each a mean of exponentials of two differences. Its leading eigenvector, scaled to [0, 1], is the
confidence of each pair; the assignment of largest sum is found, and pairs below a threshold are dropped.

Filled in or left out:

- The affinity of nodes also has a term of their positions in the world. It needs a rough pose, which an object list
  alone does not give, and is left out: the affinity of a node is that of its length and width.
- Pairs that share a box have no edge (affinity 0), as is usual in spectral matching.
- The smallest number of matches. Confidences are relative to the largest, so that the threshold alone refuses nothing.
  The paper's tracking of objects and its compensation of delays are left out.

The defaults are the best of `PYTHONPATH=benchmarks python -m peers.search VIPS` (see `peers/search.py`), 2026-11-27.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.sparse.linalg import eigsh

from cobevglue.alignment import Alignment
from cobevglue.boxes import Boxes
from cobevglue.typing import FloatArray
from peers.single_frame import SingleFrameMatcher, distances, pose_of_matches, same_class

__all__ = ["VIPS"]


@dataclass
class VIPS(SingleFrameMatcher):
    """VIPS without its rough pose.

    Attributes:
        size_rate: of the node affinity exp(-rate (dl^2 + dw^2)) [1/m^2]; 0.5 in the implementation described.
        distance_rate: of the first term of the edge affinity, exp(-rate dd^2) [1/m^2]; 0.5 there.
        heading_rate: of the second, exp(-rate |sin dpsi|), psi the angle between two headings; 0.1 there.
        heading_share: weight of the second term, that of the first is 1 minus this; 0.5 there.
        threshold: smallest confidence of a match, of at most 1; 0.5 there.
        min_matches: fewer are refused.
    """

    size_rate: float = 0.5
    distance_rate: float = 0.5
    heading_rate: float = 3.0
    heading_share: float = 0.0
    threshold: float = 0.9
    min_matches: int = 3

    @classmethod
    def published(cls) -> VIPS:
        """The settings of the implementation described, and the least number of matches that gives a pose."""
        return cls(0.5, 0.5, 0.1, 0.5, threshold=0.5, min_matches=2)

    def match(self, ego: Boxes, other: Boxes) -> Alignment:
        """The pose of the confident matches."""
        affinity = self._affinity(ego, other)
        if not affinity.any():
            return Alignment.refused("no boxes of the same class")
        _, vectors = eigsh(affinity, k=1, v0=affinity.sum(axis=1), tol=1e-6)
        confidence = np.abs(vectors[:, 0]).reshape(len(ego), len(other))
        confidence = (confidence - confidence.min()) / max(np.ptp(confidence), 1e-12)
        rows, columns = linear_sum_assignment(confidence, maximize=True)
        matches = np.column_stack([rows, columns])[confidence[rows, columns] > self.threshold]
        return pose_of_matches(ego, other, matches, self.min_matches)

    def _affinity(self, ego: Boxes, other: Boxes) -> FloatArray:
        """(M N, M N) affinities of pairs of boxes; row i N + j is the pair (i, j)."""
        m, n = len(ego), len(other)
        same = same_class(ego, other)
        sizes = ego.size[:, None, :2] - other.size[None, :, :2]
        node = np.exp(-self.size_rate * (sizes**2).sum(axis=2)) * same
        distance = distances(ego)[:, None, :, None] - distances(other)[None, :, None, :]
        turn = (ego.yaw[:, None] - ego.yaw)[:, None, :, None] - (other.yaw[:, None] - other.yaw)[None, :, None, :]
        edge = (1.0 - self.heading_share) * np.exp(-self.distance_rate * distance**2)
        edge += self.heading_share * np.exp(-self.heading_rate * np.abs(np.sin(turn)))
        edge *= same[:, :, None, None] * same[None, None, :, :]
        edge[np.arange(m), :, np.arange(m), :] = 0.0
        edge[:, np.arange(n), :, np.arange(n)] = 0.0
        affinity: FloatArray = edge.reshape(m * n, m * n)
        np.fill_diagonal(affinity, node)
        return affinity
