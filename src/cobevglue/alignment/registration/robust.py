"""The rigid motion between two sets of points of which most pairs are wrong: a solver after TEASER++, our own.

Yang, Shi and Carlone, "TEASER: Fast and Certifiable Point Cloud Registration" (T-RO 2021). In its order: differences of
positions, whose lengths no motion changes, decide which pairs are consistent (section V); of the graph of agreeing
pairs the largest clique is kept (VI); its differences give the rotation by truncated least squares, solved by graduated
non-convexity (Yang et al., RA-L 2020); then each component of the translation is the one that most pairs agree with
(V-B). The motion is refitted to all pairs that agree with it, which TEASER++ leaves to the user. Nothing is certified.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from cobevglue.alignment.registration.max_clique import max_clique
from cobevglue.typing import BoolArray, FloatArray, IntArray

__all__ = ["Motion", "robust_motion", "teaserpp_motion"]

_GNC_FACTOR, _GNC_ITERATIONS = 1.4, 100
_MAX_DIFFERENCES = 20_000


@dataclass(frozen=True, slots=True, eq=False)
class Motion:
    """What carries source to target points: target = rotation @ source + translation, in D dimensions.

    Attributes:
        rotation: (D, D) proper.
        translation: (D,) [m].
        inliers: (K,) rows that agree with it.
    """

    rotation: FloatArray
    translation: FloatArray
    inliers: IntArray


def robust_motion(target: FloatArray, source: FloatArray, noise_bound: float) -> Motion:
    """The motion that the largest group of pairs that agree with each other says.

    Args:
        target: (N, D) points [m].
        source: (N, D) the same points, as far as the pairs are right.
        noise_bound: how far a right pair may be off [m].

    Returns:
        The motion; `inliers` are fewer than D + 1 where there is no agreement, and the motion then means nothing.
    """
    dimensions = target.shape[1]
    clique = max_clique(_consistent(target, source, 2.0 * noise_bound))
    if len(clique) <= dimensions:
        return Motion(np.eye(dimensions), np.zeros(dimensions), clique)
    rotation = _rotation(target[clique], source[clique], 2.0 * noise_bound)
    offset = target[clique] - source[clique] @ rotation.T
    translation = np.array([_most_agreed(component, noise_bound) for component in offset.T])
    for _ in range(2):
        inliers = np.flatnonzero(np.linalg.norm(target - source @ rotation.T - translation, axis=1) <= noise_bound)
        if len(inliers) <= dimensions:
            break
        weight = np.ones(len(inliers))
        centre_t, centre_s = target[inliers].mean(axis=0), source[inliers].mean(axis=0)
        rotation = _kabsch(target[inliers] - centre_t, source[inliers] - centre_s, weight)
        translation = centre_t - rotation @ centre_s
    return Motion(rotation, translation, inliers)


def teaserpp_motion(library: Any, target: FloatArray, source: FloatArray, noise_bound: float) -> Motion:
    """The same by TEASER++ itself.

    Args:
        library: the module `teaserpp_python`.
        target: (N, 3) points [m].
        source: (N, 3) the same points, as far as the pairs are right.
        noise_bound: how far a right pair may be off [m].
    """
    params = library.RobustRegistrationSolver.Params()
    params.cbar2, params.noise_bound, params.estimate_scaling = 1.0, noise_bound, False
    params.rotation_gnc_factor, params.rotation_max_iterations = _GNC_FACTOR, _GNC_ITERATIONS
    params.rotation_cost_threshold = 1e-12
    solver = library.RobustRegistrationSolver(params)
    solver.solve(source.T, target.T)
    solution = solver.getSolution()
    rotation, translation = np.asarray(solution.rotation), np.asarray(solution.translation).ravel()
    gap = np.linalg.norm(target - source @ rotation.T - translation, axis=1)
    return Motion(rotation, translation, np.flatnonzero(gap <= noise_bound))


def _consistent(target: FloatArray, source: FloatArray, tolerance: float) -> BoolArray:
    """(N, N) whether two pairs are equally far apart on both sides.

    Pairs with an end in common are not: it is one object, and they would say two things about it.
    """
    from scipy.spatial.distance import pdist, squareform

    there, here = pdist(source), pdist(target)
    agree = (np.abs(there - here) <= tolerance) & (there > 0.0) & (here > 0.0)
    consistent: BoolArray = squareform(agree)
    return consistent


def _rotation(target: FloatArray, source: FloatArray, bound: float) -> FloatArray:
    """The rotation by truncated least squares on the differences of all pairs of (K, D) points."""
    i, j = np.triu_indices(len(target), 1)
    if len(i) > _MAX_DIFFERENCES:  # a regular share is as good
        step = -(-len(i) // _MAX_DIFFERENCES)
        i, j = i[::step], j[::step]
    a, b = target[j] - target[i], source[j] - source[i]
    weight = np.ones(len(a))
    rotation = _kabsch(a, b, weight)
    squared = ((a - b @ rotation.T) ** 2).sum(axis=1)
    # The surrogate cost starts nearly convex and is made to approach truncated least squares.
    mu = bound**2 / max(2.0 * squared.max() - bound**2, 1e-12)
    for _ in range(_GNC_ITERATIONS):
        low, high = mu / (mu + 1.0) * bound**2, (mu + 1.0) / mu * bound**2
        between = bound * np.sqrt(mu * (mu + 1.0) / np.maximum(squared, 1e-12)) - mu
        new_weight = np.where(squared <= low, 1.0, np.where(squared >= high, 0.0, between))
        if new_weight.sum() == 0.0 or mu > 1e6 or np.array_equal(new_weight, weight):
            break
        weight = new_weight
        rotation = _kabsch(a, b, weight)
        squared = ((a - b @ rotation.T) ** 2).sum(axis=1)
        mu *= _GNC_FACTOR
    return rotation


def _kabsch(target: FloatArray, source: FloatArray, weight: FloatArray) -> FloatArray:
    """(D, D) the proper rotation with the least weighted squared error, target = rotation @ source."""
    u, _, vt = np.linalg.svd((target * weight[:, None]).T @ source)
    signs = np.ones(len(u))
    signs[-1] = np.sign(np.linalg.det(u @ vt))
    rotation: FloatArray = (u * signs) @ vt
    return rotation


def _most_agreed(values: FloatArray, bound: float) -> float:
    """The number that most values are within the bound of, and the mean of those: TEASER's adaptive voting."""
    values = np.sort(values)
    last = np.searchsorted(values, values + 2.0 * bound, side="right")
    first = int((last - np.arange(len(values))).argmax())
    return float(values[first : last[first]].mean())
