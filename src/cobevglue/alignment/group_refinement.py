"""The poses of a group from all hypotheses that agree, by least squares (a pose graph without outliers)."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from cobevglue.alignment.uncertain_poses import difference, relative_jacobians, relative_pose
from cobevglue.typing import FloatArray

__all__ = ["refine_poses"]

_ITERATIONS = 3
"""Of Gauss and Newton: the poses start within a metre."""


def refine_poses(
    pose: FloatArray, edges: Mapping[tuple[int, int], tuple[FloatArray, FloatArray]]
) -> tuple[FloatArray, FloatArray]:
    """Poses in the frame of agent 0 that fit the relative poses of pairs best.

    Args:
        pose: (N, 3) x, y [m], yaw [rad] to start from; that of agent 0 stays.
        edges: by pair (i, j) the measured i_SE2_j (3,) and its covariance (3, 3); they connect all N agents.

    Returns:
        The poses and their (N, 3, 3) covariances. The pairs share the errors of the boxes, so more pairs than it takes
        to connect the agents add no certainty: the covariances are those of independent pairs, times the number of
        pairs over that of a tree.
    """
    pose = pose.copy()
    count = len(pose)
    for _ in range(_ITERATIONS):
        information = np.zeros((count, 3, count, 3))
        gradient = np.zeros((count, 3))
        for (i, j), (measured, covariance) in edges.items():
            found = relative_pose(pose[i], pose[j])
            by_i, by_j = relative_jacobians(pose[i], found)
            weight = np.linalg.inv(covariance)
            error = difference(found, measured)
            for a, by_a in ((i, by_i), (j, by_j)):
                gradient[a] += by_a.T @ weight @ error
                for b, by_b in ((i, by_i), (j, by_j)):
                    information[a, :, b] += by_a.T @ weight @ by_b
        free = information[1:, :, 1:].reshape(3 * count - 3, -1)
        pose[1:] -= np.linalg.solve(free, gradient[1:].ravel()).reshape(-1, 3)
    inverse = np.linalg.inv(free).reshape(count - 1, 3, count - 1, 3)
    covariances = np.zeros((count, 3, 3))
    rows = np.arange(count - 1)
    covariances[1:] = inverse[rows, :, rows] * (len(edges) / (count - 1))
    return pose, covariances
