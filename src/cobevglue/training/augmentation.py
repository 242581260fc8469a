"""Random augmentation of labelled point clouds: mirroring, rotation, scaling, vertical shift, dropped points."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from pydantic import Field

from cobevglue.datasets.labelled_cloud import LabelledCloud
from cobevglue.settings import Settings

__all__ = ["AugmentationConfig", "augment"]

_Probability = Annotated[float, Field(ge=0.0, le=1.0)]


class AugmentationConfig(Settings):
    """Settings of the augmentation.

    Attributes:
        mirror: probability of mirroring y.
        rotation: maximum rotation about z, uniform in both directions [rad]. A detection range that is not square
            needs a smaller value, because large rotations move objects out of it.
        scaling: maximum relative change of scale, uniform.
        z_shift: maximum vertical shift, uniform [m]: sensors are mounted at different heights.
        drop: probability of dropping points.
        min_keep: minimum share of the points that are kept where points are dropped.
    """

    mirror: _Probability = 0.5
    rotation: Annotated[float, Field(ge=0.0, le=math.pi)] = math.pi
    scaling: Annotated[float, Field(ge=0.0, lt=0.5)] = 0.05
    z_shift: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 0.1
    drop: _Probability = 0.3
    min_keep: Annotated[float, Field(gt=0.0, le=1.0)] = 0.5


def augment(sample: LabelledCloud, config: AugmentationConfig, random: np.random.Generator) -> LabelledCloud:
    """Augment a sample.

    Args:
        sample: is not modified.
        config: settings of the augmentation.
        random: source of randomness; the same state gives the same result.

    Returns:
        A mirrored, rotated, scaled and shifted copy. Where points are dropped, the point counts are expected values
        and are not computed anew.
    """
    # All numbers are drawn in every case, so that disabling one augmentation does not change the others.
    mirrored = random.random() < config.mirror
    angle = random.uniform(-1.0, 1.0) * config.rotation
    scale = 1.0 + random.uniform(-1.0, 1.0) * config.scaling
    shift = random.uniform(-1.0, 1.0) * config.z_shift
    dropped, keep = random.random() < config.drop, random.uniform(config.min_keep, 1.0)

    side = -1.0 if mirrored else 1.0
    c, s = math.cos(angle), math.sin(angle)
    linear = scale * np.array([[c, -s * side, 0.0], [s, c * side, 0.0], [0.0, 0.0, 1.0]])
    offset = np.array([0.0, 0.0, shift])

    points, point_count = sample.points, sample.point_count
    if dropped:
        points = points[random.random(len(points), dtype=np.float32) < keep]
        point_count = np.floor(point_count * keep).astype(np.int64)
    moved = np.empty_like(points)
    moved[:, :3] = points[:, :3] @ linear.T.astype(np.float32) + offset.astype(np.float32)
    moved[:, 3] = points[:, 3]
    boxes = sample.boxes.replace(
        center=sample.boxes.center @ linear.T + offset,
        size=sample.boxes.size * scale,
        yaw=sample.boxes.yaw * side + angle,
    )
    return LabelledCloud(moved, boxes, point_count)
