"""Ground-height normalisation: shift clouds of sensors at unusual heights to the height used in training."""

from __future__ import annotations

import numpy as np

from cobevglue.typing import Float32Array

__all__ = ["SENSOR_HEIGHT", "correct_height", "estimate_height_correction"]

SENSOR_HEIGHT = 1.9
"""Height above ground of the sensors in training [m]."""

_TOLERANCE = 0.5
"""Deviations up to this are not corrected: training covers them, and roads are not flat [m]."""
_NEAREST, _FARTHEST = 5.0, 25.0
"""Range of distances used: beyond the sensor's own vehicle, and near enough for a flat ground [m]."""
_GROUND_PERCENTILE = 20.0
"""Percentile of z used as ground height: most points in this range are on the ground, almost none below."""
_MIN_POINTS = 100


def estimate_height_correction(points: Float32Array) -> float:
    """Estimate the offset to add to z so that the ground is at the height that detectors expect [m].

    It is 0 for a sensor on a car's roof and about 3 for one on a mast.

    Args:
        points: (N, 4) x, y, z [m], intensity, in the LiDAR's frame.

    Returns:
        The offset; 0 if it is within the tolerance, or if there are too few points near the sensor.
    """
    distance = np.hypot(points[:, 0], points[:, 1])
    z = points[(distance > _NEAREST) & (distance < _FARTHEST), 2]
    z = z[np.isfinite(z)]
    if len(z) < _MIN_POINTS:
        return 0.0
    height = -float(np.percentile(z, _GROUND_PERCENTILE))
    return height - SENSOR_HEIGHT if abs(height - SENSOR_HEIGHT) > _TOLERANCE else 0.0


def correct_height(points: Float32Array, height: float) -> Float32Array:
    """Add `height` [m] to z of points (N, 4); returns the same array if it is 0."""
    return points + np.array([0.0, 0.0, height, 0.0], np.float32) if height else points
