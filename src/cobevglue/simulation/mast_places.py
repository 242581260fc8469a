"""Poses of roadside units: beside the road at a junction, with an unobstructed view."""

from __future__ import annotations

import numpy as np

from cobevglue.simulation.lidar import LidarSettings
from cobevglue.simulation.world import World, WorldAtTime
from cobevglue.typing import FloatArray

__all__ = ["mast_places"]

_ROAD_OFFSET = 1.5
"""Distance from the edge of the road [m]."""
_CENTRE_DISTANCE = 18.0
"""Preferred distance from the centre of the junction [m]."""
_SPACING = 30.0
"""Preferred distance between masts [m]."""
_CANDIDATES = 36
"""Number of candidate places."""
_OBSTACLE_RANGE = 6.0
"""Returns within this distance are obstacles: the ground is farther away, from a height of 5 m [m]."""
_OBSTACLE_SCAN = LidarSettings(
    beams=8, elevation=(-25.0, 0.0), shots=90, range=30.0, range_noise=0.0, dropout=0.0, dropout_at_zero=0.0
)


def mast_places(world: World, near: FloatArray, count: int, lidar: LidarSettings) -> list[FloatArray]:
    """Poses (4, 4) of `count` sensors on masts that face the junction nearest to a point.

    Args:
        world: the static world.
        near: (2,) point in the world frame [m]; used instead of a junction where there is none.
        count: number of masts.
        lidar: settings of the sensor; only its height is used.

    Raises:
        ValueError: too few places beside the road.
    """
    middles = np.array([junction.polygon.mean(axis=0) for junction in world.roads.junctions]).reshape(-1, 2)
    centre = middles[np.hypot(*(middles - near).T).argmin()] if len(middles) else np.asarray(near, dtype=np.float64)
    xy = world.roads.roadside(spacing=2.0, offset=_ROAD_OFFSET).xy
    xy = xy[world.roads.distance_to_road(xy) > 0.7 * _ROAD_OFFSET]
    xy = xy[np.argsort(np.abs(np.hypot(*(xy - centre).T) - _CENTRE_DISTANCE), kind="stable")[:_CANDIDATES]]
    if len(xy) < count:
        raise ValueError(f"{count} roadside units requested, but only {len(xy)} places beside the road")
    static = WorldAtTime(world, world.parked[:0])
    poses = [_pose(static, place, centre, lidar) for place in xy]
    obstructed = np.array([_obstructed_share(static, pose) for pose in poses])
    chosen: list[int] = []
    for _ in range(count):
        crowded = np.zeros(len(xy))
        for other in chosen:
            crowded += np.clip(1.0 - np.hypot(*(xy - xy[other]).T) / _SPACING, 0.0, 1.0)
        crowded[chosen] = np.inf
        chosen.append(int((obstructed + crowded).argmin()))
    return [poses[row] for row in chosen]


def _pose(static: WorldAtTime, place: FloatArray, centre: FloatArray, lidar: LidarSettings) -> FloatArray:
    x, y = (float(value) for value in place)
    yaw = float(np.arctan2(centre[1] - y, centre[0] - x))
    return static.sensor_on_mast(x, y, yaw, lidar)


def _obstructed_share(static: WorldAtTime, pose: FloatArray) -> float:
    """Share of directions obstructed near the sensor, rounded to a twentieth."""
    points = static.views([(pose, -1)], [_OBSTACLE_SCAN])[0].points
    near = (np.linalg.norm(points[:, :3], axis=1) < _OBSTACLE_RANGE).sum()
    return round(20.0 * float(near) / (_OBSTACLE_SCAN.beams * _OBSTACLE_SCAN.shots)) / 20.0
