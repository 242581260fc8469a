"""CBM, context-based matching: match boxes with similar surroundings and keep the mutually consistent matches.

Song et al., "A Spatial Calibration Method for Robust Cooperative Perception" (arXiv:2304.12033), Algorithm 1. The
implementation follows the abstract and a description of the released code; the equations were not available.

As described: the context of a box consists of the positions of all others in its own frame (heading forward). Two
contexts match where the directions differ by at most sigma 1 and the positions by at most sigma 2 (L1). The members of
each such local matching ("onlookers") then vote on its matches; matches without global consensus are dropped, as are
rows and columns with more than one match. The pose is computed from the largest matching by SVD. A matching whose boxes
are too far apart is rejected.

Our choices and omissions:

- The paper uses an initial pose: it wraps headings to (-90, 90] degrees, which is valid only if both agents' frames
  have similar directions. Here no initial pose is given. Headings are compared modulo pi as well, but each pair of
  boxes is tested with both of its contexts, and an onlooker votes with the one that agrees.
- Voting: a match is kept if at least the share `consensus` of the members have it in their own local matchings.
- A matching is rejected by the mean distance of the centres after the least-squares fit.
- Of equally large matchings the one with the smallest distance is used (in the released code the last one).
- The minimum number of matches.

The defaults are the best of `PYTHONPATH=benchmarks python -m peers.search CBM` (see `peers/search.py`), 2026-11-27.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_array, csr_array, eye_array

from cobevglue.alignment import Alignment
from cobevglue.alignment.procrustes import procrustes
from cobevglue.boxes import Boxes
from cobevglue.se2 import wrap_angle
from cobevglue.typing import FloatArray, IntArray
from peers.single_frame import SingleFrameMatcher, pose_of_matches, same_class

__all__ = ["CBM"]


@dataclass
class CBM(SingleFrameMatcher):
    """CBM without an initial pose.

    Attributes:
        angle: sigma 1, maximum difference of two directions [rad]; 10 degrees in the released code.
        position: sigma 2, maximum L1 difference of two positions [m]; 3 in the released code, 1 in its strict variant.
        consensus: minimum share of the members of a local matching that agree with a match.
        max_distance: maximum mean distance of matched centres under the pose [m]; 20 under the initial pose in the
            released code.
        min_matches: minimum number of matches; with fewer the alignment is refused.
    """

    angle: float = math.radians(30.0)
    position: float = 5.0
    consensus: float = 0.5
    max_distance: float = 1.0
    min_matches: int = 3

    @classmethod
    def published(cls) -> CBM:
        """Return CBM with the tolerances of the released code; consensus and minimum number of matches are ours."""
        return cls(math.radians(10.0), position=3.0, consensus=0.5, max_distance=20.0, min_matches=2)

    def match(self, ego: Boxes, other: Boxes) -> Alignment:
        """Estimate the pose from the largest matching with consensus."""
        best = Alignment.refused("no two contexts agree")
        nearest = math.inf
        for matches in self._largest_matchings(ego, other):
            distance = _mean_distance(ego, other, matches)
            if distance < nearest:
                best, nearest = pose_of_matches(ego, other, matches, self.min_matches), distance
        if nearest > self.max_distance and best.accepted:
            return Alignment.refused(f"matched boxes are {nearest:.1f} m apart on average")
        return best

    def _largest_matchings(self, ego: Boxes, other: Boxes) -> list[IntArray]:
        """Return all one-to-one matchings (K, 2) with consensus that have the largest size."""
        m, n = len(ego), len(other)
        local = self._local_matchings(ego, other)
        agree = local + eye_array(local.shape[0], format="csr", dtype=np.int32)
        size = np.asarray(agree.sum(axis=1)).ravel()
        votes = coo_array((agree @ agree).multiply(agree))
        kept = votes.data >= self.consensus * size[votes.row]
        seed, pair = votes.row[kept], votes.col[kept] // 2
        row, column = pair // n, pair % n
        in_row = np.bincount(seed * m + row, minlength=len(size) * m)
        in_column = np.bincount(seed * n + column, minlength=len(size) * n)
        alone = (in_row[seed * m + row] == 1) & (in_column[seed * n + column] == 1)
        seed, row, column = seed[alone], row[alone], column[alone]
        count = np.bincount(seed, minlength=len(size))
        largest = np.flatnonzero(count == max(count.max(), 2))
        found = {tuple(map(tuple, np.column_stack([row[seed == s], column[seed == s]]).tolist())) for s in largest}
        return [np.array(sorted(matches)) for matches in sorted(found)]

    def _local_matchings(self, ego: Boxes, other: Boxes) -> csr_array:
        """Return (2 M N, 2 M N) 1 where the context of a pair matches another pair.

        Index 2 (i N + j) + t is the pair (i, j) with its headings as they are (t = 0), or one of them reversed (t = 1).
        """
        m, n = len(ego), len(other)
        mine, theirs = _contexts(ego), _contexts(other)
        same = same_class(ego, other).ravel()
        turn = (ego.yaw[:, None] - other.yaw[None, :]).ravel()
        entries = []
        for t, sign in enumerate((1.0, -1.0)):
            a, b = mine[:, None, :, None], sign * theirs[None, :, None, :]
            gap = a - b
            near = np.abs(gap.real) + np.abs(gap.imag) <= self.position
            # Directions: a . b >= cos(angle) |a| |b|; a box has no direction in its own context and never matches.
            length = np.abs(a) * np.abs(b)
            near &= ((a * np.conj(b)).real >= math.cos(self.angle) * length) & (length > 0.0)
            seed, pair = np.nonzero(near.reshape(m * n, m * n) & same[:, None] & same[None, :])
            reversed_too = np.abs(wrap_angle(turn[pair] - turn[seed] - math.pi * t)) > math.pi / 2
            entries.append((2 * seed + t, 2 * pair + reversed_too))
        rows, columns = (np.concatenate(part) for part in zip(*entries, strict=True))
        return csr_array((np.ones(len(rows), np.int32), (rows, columns)), shape=(2 * m * n, 2 * m * n))


def _contexts(boxes: Boxes) -> np.typing.NDArray[np.complex128]:
    """Return (N, N) positions of box n in the frame of box m, as complex numbers x + iy [m]."""
    position = boxes.center[:, 0] + 1j * boxes.center[:, 1]
    context: np.typing.NDArray[np.complex128] = (position[None, :] - position[:, None]) * np.exp(-1j * boxes.yaw)[
        :, None
    ]
    return context


def _mean_distance(ego: Boxes, other: Boxes, matches: IntArray) -> float:
    """Return the mean distance of matched centres under their least-squares pose [m]."""
    a: FloatArray = ego.center[matches[:, 0], :2]
    b = other.center[matches[:, 1], :2]
    gap = procrustes(a, b).apply(b) - a
    return float(np.hypot(gap[:, 0], gap[:, 1]).mean())
