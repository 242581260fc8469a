"""Where roadside units stand: beside the road at a junction, where nothing is right before them."""

from __future__ import annotations

import numpy as np

from cobevglue.simulation.lidar import LidarSettings
from cobevglue.simulation.world import World, WorldAtTime
from cobevglue.typing import FloatArray

__all__ = ["mast_places"]

_FROM_ROAD = 1.5
"""Beside the edge of the road [m]."""
_FROM_CENTRE = 18.0
"""About how far from the middle of the junction [m]."""
_APART = 30.0
"""Masts are about this far from each other, where there is room [m]."""
_PLACES = 36
"""So many places are looked at."""
_TOO_NEAR = 6.0
"""What is hit within this distance is in the way: from 5 m above it the ground is farther [m]."""
_LOOK_AROUND = LidarSettings(
    beams=8, elevation=(-25.0, 0.0), shots=90, range=30.0, range_noise=0.0, dropout=0.0, dropout_at_zero=0.0
)


def mast_places(world: World, near: FloatArray, count: int, lidar: LidarSettings) -> list[FloatArray]:
    """Poses (4, 4) of up to `count` sensors on masts that look at the junction nearest to a place.

    Args:
        world: where they stand.
        near: (2,) the place, in the world frame [m]; it takes the place of a junction on roads without.
        count: how many.
        lidar: the sensor; its height counts.

    Raises:
        ValueError: there are not so many places beside the road.
    """
    middles = np.array([junction.polygon.mean(axis=0) for junction in world.roads.junctions]).reshape(-1, 2)
    centre = middles[np.hypot(*(middles - near).T).argmin()] if len(middles) else np.asarray(near, dtype=np.float64)
    xy = world.roads.roadside(spacing=2.0, offset=_FROM_ROAD).xy
    xy = xy[world.roads.distance_to_road(xy) > 0.7 * _FROM_ROAD]
    xy = xy[np.argsort(np.abs(np.hypot(*(xy - centre).T) - _FROM_CENTRE), kind="stable")[:_PLACES]]
    if len(xy) < count:
        raise ValueError(f"{count} roadside units wanted, but there are only {len(xy)} places beside the road")
    alone = WorldAtTime(world, world.parked[:0])
    poses = [_pose(alone, place, centre, lidar) for place in xy]
    hidden = np.array([_hidden(alone, pose) for pose in poses])
    chosen: list[int] = []
    for _ in range(count):
        crowded = np.zeros(len(xy))
        for other in chosen:
            crowded += np.clip(1.0 - np.hypot(*(xy - xy[other]).T) / _APART, 0.0, 1.0)
        crowded[chosen] = np.inf
        chosen.append(int((hidden + crowded).argmin()))
    return [poses[row] for row in chosen]


def _pose(alone: WorldAtTime, place: FloatArray, centre: FloatArray, lidar: LidarSettings) -> FloatArray:
    x, y = (float(value) for value in place)
    yaw = float(np.arctan2(centre[1] - y, centre[0] - x))
    return alone.sensor_on_mast(x, y, yaw, lidar)


def _hidden(alone: WorldAtTime, pose: FloatArray) -> float:
    """The share of directions in which something is right before the sensor, in steps of a twentieth."""
    points = alone.views([(pose, -1)], [_LOOK_AROUND])[0].points
    near = (np.linalg.norm(points[:, :3], axis=1) < _TOO_NEAR).sum()
    return round(20.0 * float(near) / (_LOOK_AROUND.beams * _LOOK_AROUND.shots)) / 20.0
