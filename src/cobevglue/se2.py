"""Planar rigid transforms, named `dst_SE2_src`: what maps src coordinates to dst coordinates."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cobevglue.typing import ArrayLike, FloatArray

__all__ = ["SE2", "wrap_angle"]


def wrap_angle(angle: ArrayLike) -> FloatArray:
    """The same angle in [-pi, pi), elementwise [rad]."""
    wrapped = (np.asarray(angle, dtype=np.float64) + np.pi) % (2.0 * np.pi) - np.pi
    # Just below -pi the remainder rounds to 2 pi, and the result would be +pi.
    in_interval: FloatArray = wrapped - 2.0 * np.pi * (wrapped >= np.pi)
    return in_interval


@dataclass(frozen=True, slots=True)
class SE2:
    """A rotation by `yaw` about z followed by a translation by (`x`, `y`).

    Axes are right-handed: x forward, y left, z up; yaw turns x towards y (ROS REP-103). The transform is immutable.

    Attributes:
        x: translation along the destination's x axis [m].
        y: translation along the destination's y axis [m].
        yaw: rotation [rad], kept as given; compare two of them with `wrap_angle(a.yaw - b.yaw)`.

    Raises:
        ValueError: a component is not a finite number.
    """

    x: float = 0.0
    y: float = 0.0
    yaw: float = 0.0

    def __post_init__(self) -> None:
        for name in ("x", "y", "yaw"):
            given = getattr(self, name)
            try:
                value = float(given)
            except (TypeError, ValueError):
                raise ValueError(f"SE2.{name} must be a number, got {given!r}") from None
            if not math.isfinite(value):
                raise ValueError(f"SE2.{name} must be finite, got {value}")
            object.__setattr__(self, name, value)

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> SE2:
        """The planar part of a homogeneous (3, 3) planar or (4, 4) spatial transform: roll, pitch and z are dropped.

        Raises:
            ValueError: another shape, a value that is not finite, no rotation (left-handed or scaled), or a last row
                other than 0 … 0 1 (a transposed matrix, whose translation would be lost).
        """
        m = np.asarray(matrix, dtype=np.float64)
        if m.shape not in ((3, 3), (4, 4)):
            raise ValueError(f"matrix must be (3, 3) or (4, 4), got {m.shape}")
        rotation = m[:-1, :-1]
        if not np.isfinite(m).all() or not np.allclose(rotation @ rotation.T, np.eye(len(rotation)), atol=1e-4):
            raise ValueError("matrix must be finite with an orthonormal rotation part")
        if np.linalg.det(rotation) < 0:
            raise ValueError("matrix must be a proper rotation (right-handed), its determinant is -1")
        if not np.allclose(m[-1], np.eye(len(m))[-1], atol=1e-6):
            raise ValueError(f"matrix must be homogeneous with a last row of zeros and a one, got {m[-1].tolist()}")
        return cls(m[0, -1], m[1, -1], math.atan2(m[1, 0], m[0, 0]))

    @property
    def translation(self) -> FloatArray:
        """(2,) x and y [m]."""
        return np.array([self.x, self.y])

    @property
    def rotation(self) -> FloatArray:
        """(2, 2) rotation matrix."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return np.array([[c, -s], [s, c]])

    def matrix(self) -> FloatArray:
        """(3, 3) homogeneous matrix."""
        m = np.eye(3)
        m[:2, :2] = self.rotation
        m[:2, 2] = self.translation
        return m

    def apply(self, points: ArrayLike) -> FloatArray:
        """Points of the source frame in the destination frame.

        Args:
            points: (..., 2) or (..., 3) [m]; a third coordinate (z) is passed through.

        Returns:
            An array of the same shape.

        Raises:
            ValueError: the last axis is neither 2 nor 3 long.
        """
        p = np.asarray(points, dtype=np.float64)
        if p.ndim == 0 or p.shape[-1] not in (2, 3):
            raise ValueError(f"points must be (..., 2) or (..., 3), got {p.shape}")
        moved = p.copy()
        moved[..., :2] = p[..., :2] @ self.rotation.T + self.translation
        return moved

    def inverse(self) -> SE2:
        """`src_SE2_dst`."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return SE2(-c * self.x - s * self.y, s * self.x - c * self.y, -self.yaw)

    def __matmul__(self, other: SE2) -> SE2:
        """`a_SE2_b @ b_SE2_c` is `a_SE2_c`; its yaw is wrapped to [-pi, pi)."""
        c, s = math.cos(self.yaw), math.sin(self.yaw)
        return SE2(
            self.x + c * other.x - s * other.y,
            self.y + s * other.x + c * other.y,
            _wrap(self.yaw + other.yaw),
        )

    def error_to(self, reference: SE2) -> tuple[float, float]:
        """How far this transform is from `reference`: translation [m] and absolute yaw difference [rad]."""
        yaw = abs(_wrap(self.yaw - reference.yaw))
        return math.hypot(self.x - reference.x, self.y - reference.y), yaw


def _wrap(angle: float) -> float:
    """`wrap_angle` of one number, without numpy's overhead."""
    wrapped = (angle + math.pi) % (2.0 * math.pi) - math.pi
    return wrapped if wrapped < math.pi else -math.pi
