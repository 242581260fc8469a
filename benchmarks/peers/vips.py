"""VIPS's matcher: spectral graph matching of boxes by their sizes, distances and headings.

Shi et al., "VIPS: Real-Time Perception Fusion for Infrastructure-Assisted Autonomous Driving" (MobiCom 2022), the graph
matching part. This implementation follows a description of an unofficial implementation; the full text was not
available, so equation numbers are missing.

As described: a matrix contains the affinities of all pairs of boxes (one of each agent): node affinities on the
diagonal, edge affinities elsewhere, each a mean of exponentials of two differences. Its leading eigenvector, scaled to
[0, 1], is the confidence of each pair; the assignment with the largest total confidence is computed, and pairs below a
threshold are dropped.

Our choices and omissions:

- The paper's node affinity also has a term for world positions. It requires an initial pose, which is not available
  from object lists, and is omitted: the node affinity depends on length and width only.
- Pairs that share a box have no edge (affinity 0), as usual in spectral matching.
- The minimum number of matches. Confidences are relative to the largest, so the threshold alone never causes a
  refusal.
- The paper's object tracking and delay compensation are omitted.

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
    """VIPS without an initial pose.

    Attributes:
        size_rate: rate of the node affinity exp(-rate (dl^2 + dw^2)) [1/m^2]; 0.5 in the described implementation.
        distance_rate: rate of the first term of the edge affinity, exp(-rate dd^2) [1/m^2]; 0.5 there.
        heading_rate: rate of the second term, exp(-rate |sin dpsi|), psi the angle between two headings; 0.1 there.
        heading_share: weight of the second term, with 1 minus this for the first term; 0.5 there.
        threshold: minimum confidence of a match, from 0 to 1; 0.5 there.
        min_matches: minimum number of matches; with fewer the alignment is refused.
    """

    size_rate: float = 0.5
    distance_rate: float = 0.5
    heading_rate: float = 3.0
    heading_share: float = 0.0
    threshold: float = 0.9
    min_matches: int = 3

    @classmethod
    def published(cls) -> VIPS:
        """Return VIPS with the settings of the described implementation and the minimum number of matches."""
        return cls(0.5, 0.5, 0.1, 0.5, threshold=0.5, min_matches=2)

    def match(self, ego: Boxes, other: Boxes) -> Alignment:
        """Estimate the pose from the confident matches."""
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
        """Return (M N, M N) affinities of pairs of boxes; row i N + j is the pair (i, j)."""
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
