"""Changes a sample at random the way the world could have been different; points and boxes move together."""

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
    """How much samples are changed.

    Attributes:
        mirror: share of samples whose left and right are swapped.
        rotation: turned about z by a uniform angle up to this, either way [rad]. Traffic has no preferred direction
            where the detector's range is square; where it is long and narrow, much would turn out of it.
        scaling: made larger or smaller by a uniform factor up to this.
        z_shift: moved up or down by a uniform distance up to this [m], as sensors are mounted at different heights.
        drop: share of samples that lose points ...
        min_keep: ... down to this share of them.
    """

    mirror: _Probability = 0.5
    rotation: Annotated[float, Field(ge=0.0, le=math.pi)] = math.pi
    scaling: Annotated[float, Field(ge=0.0, lt=0.5)] = 0.05
    z_shift: Annotated[float, Field(ge=0.0, allow_inf_nan=False)] = 0.1
    drop: _Probability = 0.3
    min_keep: Annotated[float, Field(gt=0.0, le=1.0)] = 0.5


def augment(sample: LabelledCloud, config: AugmentationConfig, random: np.random.Generator) -> LabelledCloud:
    """A changed copy of a sample.

    Args:
        sample: stays as it is.
        config: how much to change.
        random: decides; the same state gives the same result.

    Returns:
        The sample in a frame that is mirrored, turned, scaled and shifted. Where points are dropped, the counts are
        those to be expected, not counted again.
    """
    # All numbers are drawn whatever the settings, so that switching one change off leaves the others as they were.
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
