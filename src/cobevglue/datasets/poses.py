"""Conversion of poses and boxes of left-handed data sets to the right-handed axes of the package.

The axes of the package are x forward, y left, z up. CARLA's are left-handed: x forward, y right, z up; its yaw rotates
x towards y (clockwise seen from above), its pitch raises the front. Mirroring y converts one into the other: a
transform T becomes M T M with M = diag(1, -1, 1, 1), which is again a proper rotation.
"""

from __future__ import annotations

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.se2 import SE2
from cobevglue.typing import ArrayLike, FloatArray

__all__ = [
    "SE3_from_SE2",
    "SE3_from_carla",
    "SE3_from_lidar_pose",
    "carla_from_SE3",
    "inverse_SE3",
    "mirrored",
    "rigid_SE3",
    "transform_boxes",
    "upright_yaw",
]


def SE3_from_carla(pose: ArrayLike) -> FloatArray:
    """Convert CARLA poses to right-handed transforms.

    Args:
        pose: (..., 6) x, y, z [m], roll, yaw, pitch [degrees] (note the order), left-handed, as stored by OPV2V.

    Returns:
        (..., 4, 4) proper rigid transforms: parent_SE3_body.
    """
    pose = np.asarray(pose, dtype=np.float64)
    roll, yaw, pitch = np.moveaxis(np.deg2rad(pose[..., 3:]), -1, 0)
    # CARLA's rotation is Rz(yaw) Ry(-pitch) Rx(-roll) in the usual elementary matrices. Mirroring y reverses the
    # rotations about x and z and keeps those about y: Rz(-yaw) Ry(-pitch) Rx(roll).
    yaw, pitch = -yaw, -pitch
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(angle), np.sin(angle)) for angle in (roll, pitch, yaw))
    matrix = np.zeros((*pose.shape[:-1], 4, 4))
    matrix[..., 0, 0], matrix[..., 0, 1], matrix[..., 0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    matrix[..., 1, 0], matrix[..., 1, 1], matrix[..., 1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    matrix[..., 2, 0], matrix[..., 2, 1], matrix[..., 2, 2] = -sp, cp * sr, cp * cr
    matrix[..., :3, 3] = pose[..., :3] * [1.0, -1.0, 1.0]
    matrix[..., 3, 3] = 1.0
    return matrix


def carla_from_SE3(matrix: ArrayLike) -> FloatArray:
    """Convert right-handed transforms to CARLA poses: the inverse of `SE3_from_carla`.

    Args:
        matrix: (..., 4, 4) proper rigid transforms.

    Returns:
        (..., 6) x, y, z [m], roll, yaw, pitch [degrees], left-handed.
    """
    m = np.asarray(matrix, dtype=np.float64)
    roll = np.arctan2(m[..., 2, 1], m[..., 2, 2])
    pitch = np.arctan2(-m[..., 2, 0], np.hypot(m[..., 0, 0], m[..., 1, 0]))
    yaw = np.arctan2(m[..., 1, 0], m[..., 0, 0])
    angles = np.rad2deg(np.stack([roll, -yaw, -pitch], axis=-1))
    return np.concatenate([m[..., :3, 3] * [1.0, -1.0, 1.0], angles], axis=-1)


def SE3_from_lidar_pose(lidar_pose: ArrayLike, name: str = "lidar_pose", *, left_handed: bool = True) -> FloatArray:
    """Convert a stored `lidar_pose` of OPV2V's kind to a right-handed transform.

    Args:
        lidar_pose: x, y, z [m], roll, yaw, pitch [degrees], or a (4, 4) matrix as in some redistributions of the data.
        name: its name in error messages.
        left_handed: the axes are CARLA's. Otherwise they are right-handed, and the angles are those that CARLA's
            formulas give for such a matrix (CoAlign's and HEAL's DAIR-V2X).

    Returns:
        (4, 4) world_SE3_lidar, a proper rigid transform.

    Raises:
        ValueError: neither six finite numbers nor a rigid (4, 4) matrix.
    """
    try:
        values = np.asarray(lidar_pose, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name} {error}") from None
    if values.shape == (4, 4):
        return rigid_SE3(mirrored(values) if left_handed else values, name)
    if values.shape != (6,) or not np.isfinite(values).all():
        raise ValueError(f"{name} must be six finite numbers (x, y, z, roll, yaw, pitch), got {lidar_pose}")
    return SE3_from_carla(values) if left_handed else mirrored(SE3_from_carla(values))


def SE3_from_SE2(pose: SE2, z: float = 0.0) -> FloatArray:
    """(4, 4) spatial transform of a planar one, at height `z` [m], without roll and pitch."""
    matrix = np.eye(4)
    matrix[:2, :2] = pose.rotation
    matrix[:3, 3] = pose.x, pose.y, z
    return matrix


def mirrored(matrix: ArrayLike) -> FloatArray:
    """Mirror the y axis of both frames of transforms (..., 4, 4): M T M, from left- to right-handed or back."""
    signs = np.array([1.0, -1.0, 1.0, 1.0])
    result: FloatArray = np.asarray(matrix, dtype=np.float64) * np.outer(signs, signs)
    return result


def rigid_SE3(matrix: ArrayLike, name: str = "the matrix") -> FloatArray:
    """Orthonormalise a stored (4, 4) matrix to the nearest proper rigid transform.

    Args:
        matrix: the stored matrix.
        name: its name in error messages.

    Raises:
        ValueError: another shape, non-finite values, or a matrix that is not rigid within rounding.
    """
    try:
        m = np.array(matrix, dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{name} must be a 4x4 matrix of numbers") from None
    if m.shape != (4, 4):
        raise ValueError(f"{name} must be a finite 4x4 matrix, got shape {m.shape}")
    if not np.isfinite(m).all():
        raise ValueError(f"{name} is not finite")
    left, scale, right = np.linalg.svd(m[:3, :3])
    if np.abs(scale - 1.0).max() > 1e-2 or np.abs(m[3] - [0.0, 0.0, 0.0, 1.0]).max() > 1e-6:
        raise ValueError(
            f"{name} is not a rigid transform (its rotation is not orthonormal or its last row is not 0 0 0 1)"
        )
    if np.linalg.det(m[:3, :3]) < 0:
        raise ValueError(f"{name} is not a proper rotation (its determinant is -1)")
    m[:3, :3] = left @ right
    m[3] = [0.0, 0.0, 0.0, 1.0]
    return m


def inverse_SE3(matrix: FloatArray) -> FloatArray:
    """Invert rigid transforms (..., 4, 4)."""
    inverse = np.zeros_like(matrix)
    inverse[..., :3, :3] = np.swapaxes(matrix[..., :3, :3], -1, -2)
    inverse[..., :3, 3] = -np.einsum("...ij,...j->...i", inverse[..., :3, :3], matrix[..., :3, 3])
    inverse[..., 3, 3] = 1.0
    return inverse


def upright_yaw(matrix: FloatArray) -> FloatArray:
    """Yaw [rad] of poses (..., 4, 4) in bird's-eye view: roll and pitch are dropped."""
    yaw: FloatArray = np.arctan2(matrix[..., 1, 0], matrix[..., 0, 0])
    return yaw


def transform_boxes(boxes: Boxes, dst_SE3_src: FloatArray) -> Boxes:
    """Transform boxes from the src to the dst frame, upright there.

    Unlike `Boxes.transform`, this applies the full spatial transform, so that heights agree between agents on a slope.
    Roll and pitch of the result are dropped.

    Args:
        boxes: N boxes in the src frame.
        dst_SE3_src: (4, 4) rigid transform.
    """
    heading = np.stack([np.cos(boxes.yaw), np.sin(boxes.yaw), np.zeros(len(boxes))], axis=-1) @ dst_SE3_src[:3, :3].T
    return boxes.replace(
        center=boxes.center @ dst_SE3_src[:3, :3].T + dst_SE3_src[:3, 3],
        yaw=np.arctan2(heading[:, 1], heading[:, 0]),
    )
