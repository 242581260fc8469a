"""What agents tell aligners of the whole group, for the tests of this folder."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from cobevglue import SE2, Boxes
from cobevglue.alignment import Alignment, GroupAligner, Observation
from cobevglue.typing import Float32Array, FloatArray


def pose_of(world_SE2_lidar: SE2, z: float = 0.0) -> FloatArray:
    """(4, 4) an upright pose."""
    pose = np.eye(4)
    pose[:2, :2], pose[:2, 3], pose[2, 3] = world_SE2_lidar.rotation, world_SE2_lidar.translation, z
    return pose


def boxes_at(boxes: Boxes, world_SE2_lidar: SE2, variance: float | FloatArray | None = 0.01) -> Observation:
    """Boxes in an agent's frame, its claimed pose, and one variance for all or (K, 3); None for none told."""
    told = None if variance is None else np.broadcast_to(variance, (len(boxes), 3)).copy()
    return Observation(boxes=boxes, variance=told, pose=pose_of(world_SE2_lidar))


def align(aligner: GroupAligner, observations: Mapping[str, Observation]) -> dict[str, Alignment]:
    """The group as the system does it: the first agent is the ego, the others' observations travel."""
    ego = next(iter(observations))
    seen = {}
    for name, observation in observations.items():
        needed = aligner.select_inputs(observation)
        seen[name] = needed if name == ego else aligner.decode(aligner.encode(name, needed, 0.0, 0), needed)
    return aligner.align_group(ego, seen)


def error(alignment: Alignment, truth: SE2) -> tuple[float, float]:
    """Of an accepted pose: metres, degrees."""
    assert alignment.ego_SE2_other is not None, alignment.reason
    distance, turn = alignment.ego_SE2_other.error_to(truth)
    return distance, math.degrees(turn)


def scene(seed: int, objects: int = 25) -> FloatArray:
    """(N, 3) points on the walls of a street corner, on objects of different sizes, and on the ground at -1.9 m."""
    rng = np.random.default_rng([seed, 10, 0])
    ground = np.column_stack([rng.uniform(-30.0, 30.0, (12_000, 2)), np.full(12_000, -1.9)])
    walls = []
    for along in (0, 1):
        at = np.column_stack([rng.uniform(-25.0, 20.0, 4000), np.full(4000, 20.0)])
        walls.append(np.column_stack([at[:, :: 1 - 2 * along] if along else at, rng.uniform(-1.9, 3.0, 4000)]))
    solids = []
    for _ in range(objects):
        half = rng.uniform((0.3, 0.3, 0.5), (3.0, 1.2, 1.8))
        x, y, yaw = rng.uniform((-18.0, -18.0, -math.pi), (18.0, 18.0, math.pi))
        place = SE2(x, y, yaw)
        skin = rng.uniform(-1.0, 1.0, (600, 3))
        side = rng.integers(3, size=600)
        skin[np.arange(600), side] = np.sign(skin[np.arange(600), side])
        solids.append(place.apply(skin * half + (0.0, 0.0, half[2] - 1.9)))
    return np.concatenate([ground, *walls, *solids])


def cloud_of(points: FloatArray, world_SE2_lidar: SE2, seed: int, share: float = 0.6) -> Float32Array:
    """(n, 4) what an agent there sees of it: a random share of the points, with 2 cm noise."""
    rng = np.random.default_rng([seed, 11, 0])
    seen = points[rng.random(len(points)) < share]
    seen = world_SE2_lidar.inverse().apply(seen) + rng.normal(0.0, 0.02, seen.shape)
    return np.column_stack([seen, np.full(len(seen), 0.5)]).astype(np.float32)
