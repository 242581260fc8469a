"""Arrays of planar poses with covariances: composition, inverse, relative pose.

A pose is (x [m], y [m], yaw [rad]) along the last axis, a covariance (3, 3) along the last two. Covariances are of
additive errors of the three numbers, carried over to first order (Smith, Self and Cheeseman, "Estimating Uncertain
Spatial Relationships in Robotics", 1990). All functions broadcast over the leading axes. Errors of two arguments are
taken to be independent.
"""

from __future__ import annotations

import numpy as np

from cobevglue.se2 import SE2, wrap_angle
from cobevglue.typing import FloatArray

__all__ = ["compose", "difference", "invert", "relative", "relative_pose", "to_se2", "to_xyyaw"]


def to_xyyaw(pose: SE2) -> FloatArray:
    """(3,) of a transform."""
    return np.array([pose.x, pose.y, pose.yaw])


def to_se2(pose: FloatArray) -> SE2:
    """The transform of (3,)."""
    return SE2(pose[0], pose[1], pose[2])


def compose(
    a_SE2_b: FloatArray, a_covariance: FloatArray, b_SE2_c: FloatArray, b_covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """a_SE2_c and its covariance."""
    cos, sin = np.cos(a_SE2_b[..., 2]), np.sin(a_SE2_b[..., 2])
    dx = cos * b_SE2_c[..., 0] - sin * b_SE2_c[..., 1]
    dy = sin * b_SE2_c[..., 0] + cos * b_SE2_c[..., 1]
    yaw = wrap_angle(a_SE2_b[..., 2] + b_SE2_c[..., 2])
    pose = np.stack([a_SE2_b[..., 0] + dx, a_SE2_b[..., 1] + dy, yaw], axis=-1)
    turned = _similar(_rotation(cos, sin), b_covariance)
    covariance: FloatArray = _similar(_lever(dx, dy), a_covariance) + turned
    return pose, covariance


def invert(a_SE2_b: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
    """b_SE2_a and its covariance."""
    cos, sin = np.cos(a_SE2_b[..., 2]), np.sin(a_SE2_b[..., 2])
    x = -cos * a_SE2_b[..., 0] - sin * a_SE2_b[..., 1]
    y = sin * a_SE2_b[..., 0] - cos * a_SE2_b[..., 1]
    pose = np.stack([x, y, wrap_angle(-a_SE2_b[..., 2])], axis=-1)
    # d(-R^T t) = -R^T dt + (y, -x) dyaw, and the yaw changes sign.
    jacobian = -_rotation(cos, -sin)
    jacobian[..., 0, 2], jacobian[..., 1, 2] = y, -x
    return pose, _similar(jacobian, covariance)


def relative_pose(w_SE2_a: FloatArray, w_SE2_b: FloatArray) -> FloatArray:
    """a_SE2_b without a covariance."""
    cos, sin = np.cos(w_SE2_a[..., 2]), np.sin(w_SE2_a[..., 2])
    dx, dy = w_SE2_b[..., 0] - w_SE2_a[..., 0], w_SE2_b[..., 1] - w_SE2_a[..., 1]
    yaw = wrap_angle(w_SE2_b[..., 2] - w_SE2_a[..., 2])
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx, yaw], axis=-1)


def relative(
    w_SE2_a: FloatArray, a_covariance: FloatArray, w_SE2_b: FloatArray, b_covariance: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """a_SE2_b and its covariance."""
    pose = relative_pose(w_SE2_a, w_SE2_b)
    by_a, by_b = relative_jacobians(w_SE2_a, pose)
    covariance: FloatArray = _similar(by_a, a_covariance) + _similar(by_b, b_covariance)
    return pose, covariance


def relative_jacobians(w_SE2_a: FloatArray, a_SE2_b: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(..., 3, 3) derivatives of a_SE2_b by w_SE2_a and by w_SE2_b."""
    cos, sin = np.cos(w_SE2_a[..., 2]), np.sin(w_SE2_a[..., 2])
    by_b = _rotation(cos, -sin)
    by_b = np.broadcast_to(by_b, (*a_SE2_b.shape, 3))
    by_a = -by_b.copy()
    by_a[..., 0, 2], by_a[..., 1, 2] = a_SE2_b[..., 1], -a_SE2_b[..., 0]
    return by_a, by_b


def difference(pose: FloatArray, reference: FloatArray) -> FloatArray:
    """(..., 3) pose minus reference, the yaw in [-pi, pi)."""
    gap = pose - reference
    gap[..., 2] = wrap_angle(gap[..., 2])
    return gap


def _rotation(cos: FloatArray, sin: FloatArray) -> FloatArray:
    """(..., 3, 3) that turns x and y and leaves the yaw."""
    matrix = np.zeros((*np.shape(cos), 3, 3))
    matrix[..., 0, 0] = matrix[..., 1, 1] = cos
    matrix[..., 0, 1], matrix[..., 1, 0] = -sin, sin
    matrix[..., 2, 2] = 1.0
    return matrix


def _lever(dx: FloatArray, dy: FloatArray) -> FloatArray:
    """(..., 3, 3) derivative of a composed pose by its first factor, whose yaw moves the arm (dx, dy)."""
    matrix = np.zeros((*np.shape(dx), 3, 3))
    matrix[..., [0, 1, 2], [0, 1, 2]] = 1.0
    matrix[..., 0, 2], matrix[..., 1, 2] = -dy, dx
    return matrix


def _similar(jacobian: FloatArray, covariance: FloatArray) -> FloatArray:
    product: FloatArray = jacobian @ covariance @ jacobian.swapaxes(-1, -2)
    return product
