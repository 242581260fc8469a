"""CLIPPER: the densest set of consistent associations, by projected gradient ascent.

Lusk, Fathian, How, "CLIPPER: A Graph-Theoretic Framework for Robust Data Association" (ICRA 2021, arXiv:2011.10202),
and Lusk, How, "CLIPPER: Robust Data Association without an Initial Guess" (RA-L 2024, arXiv:2402.07284): the densest
edge-weighted clique and its first-order relaxation. The authors' bindings are not on PyPI and must be built from
source. This implementation follows the papers' abstracts; the full texts were not available.

Associations are the nodes of a graph: all pairs of boxes, one of each agent. The affinity of two is exp(-c^2 / 2
sigma^2), with c the difference of the distances between the boxes, and 0 where c exceeds epsilon or where they share a
box. u' M u over u >= 0, |u| <= 1 is maximised by projected gradient ascent with backtracking. A penalty d on pairs of
inconsistent associations increases until no such pair remains. The omega = round(u' M u) associations with the largest
u are selected, and the pose is computed from them by SVD.

Our choices:

- CLIPPER can use any invariant. `heading` adds a second one: the angle between two headings, modulo pi. Unlike
  distances, it also excludes most mirrored sets.
- The initial u is M 1 instead of random, and the penalty increases by the smallest ratio that decreases the u of an
  inconsistent association.
- Associations with fewer than `min_matches` - 1 consistent associations are removed first: no accepted clique can
  contain them.
- The minimum number of matches.

The defaults are the best of `PYTHONPATH=benchmarks python -m peers.search Clipper` (see `peers/search.py`), 2026-11-27.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cobevglue.alignment import Alignment
from cobevglue.boxes import Boxes
from cobevglue.se2 import wrap_angle
from cobevglue.typing import FloatArray
from peers.single_frame import SingleFrameMatcher, distances, pose_of_matches, same_class

__all__ = ["Clipper"]

_STEPS, _PENALTIES, _BACKTRACKS = 200, 100, 20
"""Maximum numbers of ascent steps per penalty, of penalties, and of step lengths."""
_BETA = 0.25
"""Factor of the step length in backtracking."""
_TOLERANCE = 1e-6
"""The ascent ends when a step changes u by less than this; smaller entries of u are set to 0."""


@dataclass
class Clipper(SingleFrameMatcher):
    """CLIPPER on box centres, with headings as a second invariant.

    Attributes:
        sigma: scale of the difference of two distances [m]; 0.01 in the authors' library, too small for boxes.
        epsilon: maximum consistent difference of two distances [m]; 0.06 in the authors' library.
        min_distance: minimum distance of two boxes of one agent with consistent associations [m]; 0 in the authors'
            library.
        heading: maximum consistent difference of angles between headings, modulo pi [rad]; pi / 2 for no limit.
        min_matches: minimum number of matches; with fewer the alignment is refused.
    """

    sigma: float = 0.8
    epsilon: float = 1.5
    min_distance: float = 2.0
    heading: float = math.radians(20.0)
    min_matches: int = 3

    @classmethod
    def published(cls) -> Clipper:
        """Return CLIPPER with the defaults of the authors' library, for centimetre accuracy, with distances only."""
        return cls(sigma=0.01, epsilon=0.06, min_distance=0.0, heading=math.pi / 2, min_matches=2)

    def match(self, ego: Boxes, other: Boxes) -> Alignment:
        """Estimate the pose from the densest clique."""
        affinity = self._affinity(ego, other)
        nodes = _core(affinity, self.min_matches - 1)
        if not len(nodes):
            return Alignment.refused(f"no {self.min_matches} associations are consistent")
        affinity = affinity[np.ix_(nodes, nodes)]
        u = densest_clique(affinity)
        count = max(1, round(float(u @ affinity @ u)))
        selected = np.argsort(-u, kind="stable")[:count]
        pairs = nodes[selected[u[selected] > _TOLERANCE]]
        matches = np.column_stack(np.divmod(pairs, len(other)))
        return pose_of_matches(ego, other, matches, self.min_matches)

    def _affinity(self, ego: Boxes, other: Boxes) -> FloatArray:
        """Return (M N, M N) affinities with ones on the diagonal; row i N + j is the association (i, j)."""
        m, n = len(ego), len(other)
        mine, theirs = distances(ego)[:, None, :, None], distances(other)[None, :, None, :]
        gap = mine - theirs
        consistent = (np.abs(gap) < self.epsilon) & (mine > self.min_distance) & (theirs > self.min_distance)
        if self.heading < math.pi / 2:
            turn = (ego.yaw[:, None] - ego.yaw)[:, None, :, None] - (other.yaw[:, None] - other.yaw)[None, :, None, :]
            consistent &= np.abs(wrap_angle(2.0 * turn)) < 2.0 * self.heading
        same = same_class(ego, other)
        consistent &= same[:, :, None, None] & same[None, None, :, :]
        consistent[np.arange(m), :, np.arange(m), :] = False
        consistent[:, np.arange(n), :, np.arange(n)] = False
        values = np.where(consistent, np.exp(-(gap**2) / (2.0 * self.sigma**2)), 0.0)
        affinity: FloatArray = values.reshape(m * n, m * n)
        np.fill_diagonal(affinity, 1.0)
        return affinity


def densest_clique(affinity: FloatArray) -> FloatArray:
    """Return (n,) u >= 0 of unit length: a local maximum of u' M u that is zero outside of a clique.

    Args:
        affinity: (n, n) M, symmetric, ones on the diagonal, 0 where two nodes are inconsistent.
    """
    inconsistent = (affinity == 0.0).astype(np.float64)
    u: FloatArray = affinity.sum(axis=1)
    u /= np.linalg.norm(u)
    penalty = 0.0
    for _ in range(_PENALTIES):
        u = _ascend(affinity - penalty * inconsistent, u)
        charge = np.where(u > _TOLERANCE, inconsistent @ u, 0.0)
        violated = charge > _TOLERANCE
        if not violated.any():
            break
        ratio = (affinity @ u)[violated] / charge[violated] - penalty
        penalty += max(float(ratio.min()), 0.1)
    return u


def _ascend(matrix: FloatArray, u: FloatArray) -> FloatArray:
    """Maximise u' A u by projected gradient ascent on the part of the unit sphere with u >= 0."""
    product = matrix @ u
    value = float(u @ product)
    for _ in range(_STEPS):
        gradient = 2.0 * (product - value * u)  # the component tangential to the sphere
        step = 1.0
        for _ in range(_BACKTRACKS):
            moved = np.maximum(u + step * gradient, 0.0)
            moved /= np.linalg.norm(moved)
            new_product = matrix @ moved
            new_value = float(moved @ new_product)
            if new_value >= value:
                break
            step *= _BETA
        else:
            return u
        change = float(np.linalg.norm(moved - u))
        u, product, value = moved, new_product, new_value
        if change < _TOLERANCE:
            break
    return u


def _core(affinity: FloatArray, degree: int) -> np.typing.NDArray[np.int64]:
    """Return the nodes of the largest subgraph in which each node has at least `degree` neighbours."""
    adjacent = affinity > 0.0
    nodes = np.arange(len(adjacent))
    while len(nodes):
        kept = adjacent[np.ix_(nodes, nodes)].sum(axis=1) - 1 >= degree
        if kept.all():
            break
        nodes = nodes[kept]
    return nodes
