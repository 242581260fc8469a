"""A model of the errors of a LiDAR detector: displaced, missed, flipped and false boxes."""

from __future__ import annotations

import math
from typing import Annotated

import numpy as np
from pydantic import Field

from cobevglue.boxes import Boxes
from cobevglue.se2 import wrap_angle
from cobevglue.settings import Settings
from cobevglue.typing import FloatArray, IntArray

__all__ = ["DetectionErrors", "add_detection_errors"]

_Spread = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
_Probability = Annotated[float, Field(ge=0.0, le=1.0)]

_FALSE_SIZE = (4.5, 1.9, 1.6)
"""Length, width, height of a false box [m]: that of a car."""
_TRUE_SCORE, _TRUE_SCORE_LOST_PER_M, _FALSE_SCORE = 0.9, 0.004, 0.35
"""Mean scores: a true box close by, what it loses with range, and a false box at any range."""
_SMALLEST_SIZE_FACTOR = 0.5
"""Size noise never shrinks a box below this fraction of its true size, so that sizes stay valid."""


class DetectionErrors(Settings):
    """Parameters of detection errors. The defaults resemble a PointPillars detector on cars.

    Attributes:
        center_std: standard deviation of the centre's x and of its y, at the agent's origin [m].
        center_std_per_m: what `center_std` grows by for each metre of distance from the agent's origin [m/m].
        z_std: standard deviation of the centre's z [m].
        yaw_std: standard deviation of the heading [rad].
        size_std: standard deviation of length, width and height [m]; a height of 0 (unknown) stays 0.
        missed: probability that an object is not detected.
        flipped: probability that a detected box's heading is turned by 180 degrees.
        false_per_frame: mean number of false boxes in a frame (Poisson).
        false_range: false boxes are spread evenly over a disc of this radius around the agent's origin [m].
        score_std: standard deviation of the score around its mean.

    Raises:
        ValueError: a negative spread, a probability outside [0, 1], or an unknown field.
    """

    center_std: _Spread = 0.2
    center_std_per_m: _Spread = 0.004
    z_std: _Spread = 0.1
    yaw_std: _Spread = math.radians(2.0)
    size_std: tuple[_Spread, _Spread, _Spread] = (0.3, 0.1, 0.1)
    missed: _Probability = 0.15
    flipped: _Probability = 0.04
    false_per_frame: _Spread = 1.0
    false_range: _Spread = 60.0
    score_std: _Spread = 0.1

    @classmethod
    def none(cls) -> DetectionErrors:
        """A perfect detector: every level is zero."""
        return cls(
            center_std=0.0,
            center_std_per_m=0.0,
            z_std=0.0,
            yaw_std=0.0,
            size_std=(0.0, 0.0, 0.0),
            missed=0.0,
            flipped=0.0,
            false_per_frame=0.0,
            score_std=0.0,
        )


def add_detection_errors(boxes: Boxes, errors: DetectionErrors, rng: np.random.Generator) -> tuple[Boxes, IntArray]:
    """What a detector with these errors would output for these true boxes.

    The random numbers of an object are drawn whether it is detected or not and whatever the levels are, so that
    changing one level leaves the other errors of the same seed as they were. A false box may fall onto a true one.

    Args:
        boxes: the true boxes in the agent's own frame (its origin is where distances are measured from).
        errors: the levels.
        rng: `np.random.default_rng([seed, stream, index])` of this agent and frame.

    Returns:
        The detections, best score first as a detector gives them, with a score, with labels if `boxes` has them (false
        boxes are cars), and without track ids: a detector knows no identities. And `rows`, (M,) the row of `boxes`
        that each detection came from, -1 for a false box.
    """
    detected, detected_rows = _detect(boxes, errors, rng)
    ground = float(np.median(boxes.center[:, 2])) if len(boxes) else 0.0
    false = _false_boxes(errors, ground, boxes.label is not None, rng)
    found = Boxes.concatenate([part for part in (detected, false) if len(part)] or [detected])
    rows = np.concatenate([detected_rows, np.full(len(false), -1, dtype=np.int64)])
    assert found.score is not None
    order = np.argsort(-found.score, kind="stable")
    return found[order], rows[order]


def _detect(boxes: Boxes, errors: DetectionErrors, rng: np.random.Generator) -> tuple[Boxes, IntArray]:
    """The true boxes that are detected, with their errors, and their rows in `boxes`."""
    n = len(boxes)
    center_noise, size_noise = rng.standard_normal((n, 3)), rng.standard_normal((n, 3))
    yaw_noise, score_noise = rng.standard_normal(n), rng.standard_normal(n)
    is_missed, is_flipped = rng.random(n) < errors.missed, rng.random(n) < errors.flipped

    distance = np.hypot(boxes.center[:, 0], boxes.center[:, 1])
    plane_std = errors.center_std + errors.center_std_per_m * distance
    center_std = np.column_stack([plane_std, plane_std, np.full(n, errors.z_std)])
    size = np.maximum(boxes.size + size_noise * errors.size_std, _SMALLEST_SIZE_FACTOR * boxes.size)
    size[:, 2] = np.where(boxes.size[:, 2] == 0, 0.0, size[:, 2])
    erroneous = Boxes(
        center=boxes.center + center_noise * center_std,
        size=size,
        yaw=wrap_angle(boxes.yaw + yaw_noise * errors.yaw_std + np.pi * is_flipped),
        score=_clip_score(_TRUE_SCORE - _TRUE_SCORE_LOST_PER_M * distance + score_noise * errors.score_std),
        label=boxes.label,
    )
    rows = np.flatnonzero(~is_missed).astype(np.int64)
    return erroneous[rows], rows


def _false_boxes(errors: DetectionErrors, ground: float, with_label: bool, rng: np.random.Generator) -> Boxes:
    """Car-sized boxes where there is nothing, at height `ground` [m], evenly spread around the agent."""
    n = int(rng.poisson(errors.false_per_frame))
    distance = errors.false_range * np.sqrt(rng.random(n))  # the root makes the density even over the disc's area
    bearing = rng.uniform(-np.pi, np.pi, n)
    size = np.maximum(_FALSE_SIZE + rng.standard_normal((n, 3)) * errors.size_std, 0.5 * np.array(_FALSE_SIZE))
    return Boxes(
        center=np.column_stack([distance * np.cos(bearing), distance * np.sin(bearing), np.full(n, ground)]),
        size=size,
        yaw=rng.uniform(-np.pi, np.pi, n),
        score=_clip_score(_FALSE_SCORE + rng.standard_normal(n) * errors.score_std),
        label=np.full(n, "car") if with_label else None,
    )


def _clip_score(score: FloatArray) -> FloatArray:
    """Scores as a detector reports them: none below 0.05, none above 1."""
    clipped: FloatArray = np.clip(score, 0.05, 1.0)
    return clipped
