"""Sensors stand at different heights, detectors are trained at one: by how much a cloud has to be raised."""

from __future__ import annotations

import numpy as np

from cobevglue.typing import Float32Array

__all__ = ["SENSOR_HEIGHT", "lifted", "needed_raise"]

SENSOR_HEIGHT = 1.9
"""Above the ground, of the sensors that the detectors here are trained with [m]."""

_TOLERANCE = 0.5
"""So far off, a cloud is left as it is: training has seen as much, and roads roll [m]."""
_NEAREST, _FARTHEST = 5.0, 25.0
"""Beyond the body that carries the sensor, and before hills matter [m]."""
_GROUND_SHARE = 20.0
"""Percentile of z that is ground: more than half of the points there are on it, hardly any below."""
_FEWEST = 100


def needed_raise(points: Float32Array) -> float:
    """What to add to z so that the ground around the sensor is where detectors expect it [m].

    It is 0 for a sensor on the roof of a car, about 3 for one on a mast, and tells nothing of where in the world the
    sensor is.

    Args:
        points: (N, 4) x, y, z [m], intensity, in the LiDAR's frame.

    Returns:
        0 where the ground is close to where it is expected, or where there are too few points to tell.
    """
    distance = np.hypot(points[:, 0], points[:, 1])
    around = points[(distance > _NEAREST) & (distance < _FARTHEST), 2]
    around = around[np.isfinite(around)]
    if len(around) < _FEWEST:
        return 0.0
    height = -float(np.percentile(around, _GROUND_SHARE))
    return height - SENSOR_HEIGHT if abs(height - SENSOR_HEIGHT) > _TOLERANCE else 0.0


def lifted(points: Float32Array, height: float) -> Float32Array:
    """(N, 4) the points with `height` [m] added to z; themselves where it is 0."""
    return points + np.array([0.0, 0.0, height, 0.0], np.float32) if height else points
