"""The relative pose of matched points (paper, section 4.3)."""

from __future__ import annotations

import numpy as np

from cobevglue.se2 import SE2
from cobevglue.typing import FloatArray

__all__ = ["procrustes"]


def procrustes(ego: FloatArray, other: FloatArray) -> SE2:
    """The rigid motion that carries other's points onto ego's with the least squared error, by SVD (Eq. 7).

    The paper prints the objective for the opposite map, ego to other; this is its inverse, `ego_SE2_other`.

    Args:
        ego: (K, 2) points [m], K >= 1. With a single point, or all in one place, the rotation is left at zero.
        other: (K, 2) the same points in the other frame.
    """
    ego_center, other_center = ego.mean(axis=0), other.mean(axis=0)
    u, _, vt = np.linalg.svd((other - other_center).T @ (ego - ego_center))
    # A reflection would fit a mirrored scene better; only proper rotations are poses.
    rotation = vt.T @ np.diag([1.0, np.linalg.det(vt.T @ u.T)]) @ u.T
    yaw = float(np.arctan2(rotation[1, 0], rotation[0, 0]))
    turned = SE2(0.0, 0.0, yaw).apply(other_center)
    return SE2(ego_center[0] - turned[0], ego_center[1] - turned[1], yaw)
