"""Height, roll and pitch of another agent's frame, from the heights of the objects that both agents see.

The pose that aligners return is planar. A roadside unit looks down from a mast, and a vehicle on a slope or with a
sensor mounted askew has a frame that is tilted against the ego's. With the *level frame* of the other agent, which has
its origin below or above that of the other's frame in the ego's xy plane, the xy plane of the ego and the heading of
the other, the pose in space is

    ego_SE3_other = SE3(ego_SE2_level) @ level_SE3_other,   level_SE3_other = [Ry(pitch) Rx(roll), (0, 0, z)]

A matched object at (x_o, y_o, z_o) in the other's frame has the height

    z_e = z - sin(pitch) x_o + cos(pitch) sin(roll) y_o + cos(pitch) cos(roll) z_o

in the ego frame. Neither the position nor the heading of the other agent are in this equation, so z, roll and pitch
follow from the matches alone, and those of a roadside unit stay the same whatever way an ego drives on level ground.
Box centres are compared: their heights scatter less than those of the bottoms (docs/levelling.md).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from cobevglue.alignment.alignment import Alignment
from cobevglue.alignment.procrustes import procrustes
from cobevglue.boxes import Boxes
from cobevglue.datasets.poses import SE3_from_SE2, transform_boxes
from cobevglue.se2 import SE2
from cobevglue.settings import Settings
from cobevglue.typing import ArrayLike, FloatArray

__all__ = ["Levelling", "LevellingConfig", "LevellingFilter", "estimate_levelling"]

_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]

_FEWEST_PAIRS = 3
"""Of fewer points no plane is known."""
_OBSERVABLE = 0.5
"""A component is observable if its standard deviation is below this share of the prior's."""
_MOST_ROUNDS = 40


class LevellingConfig(Settings):
    """Settings of `estimate_levelling` and `LevellingFilter`.

    Attributes:
        height_std: of the difference between two agents' heights of the centre of one object [m].
        outlier: differences beyond this many standard deviations hardly count (Geman-McClure).
        z_std: prior of z, whose mean is 0 [m].
        tilt_std: prior of roll and of pitch, whose means are 0 [rad].
        correlation: how many frames in a row share their errors, in the filter: heights count that much less.

    Raises:
        ValueError: a value out of its range or an unknown field.
    """

    height_std: _Positive = 0.15
    outlier: _Positive = 3.0
    z_std: _Positive = 5.0
    tilt_std: _Positive = math.radians(5.0)
    correlation: Annotated[float, Field(ge=1.0, allow_inf_nan=False)] = 3.0


@dataclass(frozen=True, eq=False, slots=True)
class Levelling:
    """The part of the pose of another agent that is not planar.

    Attributes:
        z: height of the origin of the other's frame above the ego's xy plane [m].
        roll: rotation about the other's x axis [rad], left side up if positive.
        pitch: rotation about the y axis of the level frame [rad], front down if positive.
        covariance: (3, 3) of z, roll and pitch [m, rad, rad]; that of the prior where nothing is known.
        observable: whether the heights determine z, roll and pitch. An unobservable component is near 0, its prior.
        pairs: how many matched pairs with known heights were used.
    """

    z: float
    roll: float
    pitch: float
    covariance: FloatArray
    observable: tuple[bool, bool, bool]
    pairs: int

    @property
    def level_SE3_other(self) -> FloatArray:
        """(4, 4) from the other's frame to its level frame: upright, at the height of the ego's xy plane."""
        from scipy.spatial.transform import Rotation  # here, as it slows down the import of the package

        matrix = np.eye(4)
        matrix[:3, :3] = Rotation.from_euler("ZYX", [0.0, self.pitch, self.roll]).as_matrix()
        matrix[2, 3] = self.z
        return matrix

    def level(self, boxes: Boxes) -> Boxes:
        """N boxes of the other's frame in its level frame, upright there."""
        return transform_boxes(boxes, self.level_SE3_other)

    def height_std(self, points: ArrayLike) -> FloatArray:
        """(N,) standard deviation of the heights of (N, 3) points of the other's frame in the ego frame [m]."""
        jacobian = _heights(np.array([self.z, self.roll, self.pitch]), np.asarray(points, dtype=np.float64))[1]
        std: FloatArray = np.sqrt(np.einsum("ij,jk,ik->i", jacobian, self.covariance, jacobian))
        return std

    def ego_SE2_level(self, alignment: Alignment, other: Boxes) -> SE2:
        """The pose of the level frame.

        A pose that was fitted to boxes of a tilted frame is displaced: of a mast of height h it lies about
        h sin(pitch) too far ahead. The displacement is known: it is the planar motion between the matched boxes as
        they were aligned and the same boxes levelled.

        Args:
            alignment: of the other's boxes as they are, not levelled.
            other: these boxes, in the other's frame.

        Raises:
            ValueError: the alignment was refused.
        """
        if alignment.ego_SE2_other is None:
            raise ValueError(f"no pose: {alignment.reason}")
        if len(alignment.matches) == 0:
            return alignment.ego_SE2_other
        matched = other[alignment.matches[:, 1]]
        return alignment.ego_SE2_other @ procrustes(matched.center[:, :2], self.level(matched).center[:, :2])

    def ego_SE3_other(self, alignment: Alignment, other: Boxes) -> FloatArray:
        """(4, 4) pose of the other's frame in the ego frame, in space; arguments and errors of `ego_SE2_level`."""
        pose: FloatArray = SE3_from_SE2(self.ego_SE2_level(alignment, other)) @ self.level_SE3_other
        return pose

    def boxes_in_ego(self, alignment: Alignment, other: Boxes) -> Boxes:
        """The other's boxes in the ego frame with their heights there; arguments and errors of `ego_SE2_level`.

        Like `Alignment.boxes_at_ego_instant`, this moves them by their velocity and the time offset.
        """
        if alignment.ego_SE2_other is None:
            raise ValueError(f"no pose: {alignment.reason}")
        at_ego_instant = alignment.boxes_at_ego_instant(other).transform(alignment.ego_SE2_other.inverse())
        return transform_boxes(at_ego_instant, self.ego_SE3_other(alignment, other))


def estimate_levelling(
    ego: Boxes, other: Boxes, alignment: Alignment, config: LevellingConfig | None = None
) -> Levelling:
    """Height, roll and pitch of the other's frame from the matched pairs of one frame.

    Maximum a posteriori: Gauss-Newton on the heights of the matched centres, with a Geman-McClure weight whose scale
    falls from all pairs to `outlier` (graduated non-convexity, Yang et al., "Graduated Non-Convexity for Robust Spatial
    Perception", 2020), and a Gaussian prior. Pairs in which a box has no height (0, unknown) are not used, since
    its z means nothing then.

    Args:
        ego: the ego's boxes, in its frame.
        other: the other's boxes, in its frame.
        alignment: of the two lists. A refused one has no matches: the result is the prior, and nothing is observable.
        config: the settings.

    Raises:
        ValueError: a match beyond the rows of `ego` or `other`.
    """
    config = config or LevellingConfig()
    mean, covariance = _prior(config)
    seen, expected = _matched_centers(ego, other, alignment)
    mean, covariance = _fit(seen, expected, mean, covariance, config, correlation=1.0)
    return _levelling(mean, covariance, len(seen), config)


class LevellingFilter:
    """Height, roll and pitch of an agent that does not tilt, such as a roadside unit, from many frames.

    The result of the frames so far is the prior of the next one (a recursive least squares filter). For a tilt that
    changes, such as that of a vehicle on a hilly road, use `estimate_levelling` in every frame.

    The roadside unit must be the *other* agent. Where it is the ego, exchange the lists: its tilt is constant in its
    own axes.

    Attributes:
        config: the settings.
        levelling: the result so far; the prior before the first update.
    """

    def __init__(self, config: LevellingConfig | None = None) -> None:
        self.config = config or LevellingConfig()
        self.reset()

    def reset(self) -> None:
        """Forget everything seen so far."""
        self.levelling = _levelling(*_prior(self.config), 0, self.config)

    def update(self, ego: Boxes, other: Boxes, alignment: Alignment) -> Levelling:
        """The result with one more frame; arguments and errors of `estimate_levelling`."""
        before = self.levelling
        seen, expected = _matched_centers(ego, other, alignment)
        mean = np.array([before.z, before.roll, before.pitch])
        mean, covariance = _fit(seen, expected, mean, before.covariance, self.config, self.config.correlation)
        self.levelling = _levelling(mean, covariance, before.pairs + len(seen), self.config)
        return self.levelling


def _prior(config: LevellingConfig) -> tuple[FloatArray, FloatArray]:
    return np.zeros(3), np.diag([config.z_std**2, config.tilt_std**2, config.tilt_std**2])


def _levelling(mean: FloatArray, covariance: FloatArray, pairs: int, config: LevellingConfig) -> Levelling:
    std = np.sqrt(covariance.diagonal())
    z, roll, pitch = std < _OBSERVABLE * np.array([config.z_std, config.tilt_std, config.tilt_std])
    enough = pairs >= _FEWEST_PAIRS
    observable = bool(z), bool(roll and enough), bool(pitch and enough)
    return Levelling(float(mean[0]), float(mean[1]), float(mean[2]), covariance, observable, pairs)


def _matched_centers(ego: Boxes, other: Boxes, alignment: Alignment) -> tuple[FloatArray, FloatArray]:
    """(K, 3) centres in the other's frame, and (K,) heights in the ego's [m], of the pairs whose heights are known."""
    matches = alignment.matches
    for column, boxes, name in ((0, ego, "ego"), (1, other, "other")):
        beyond = (matches[:, column] < 0) | (matches[:, column] >= len(boxes))
        if beyond.any():
            row = int(beyond.argmax())
            raise ValueError(f"matches: row {row} is {matches[row].tolist()}, but {name} has {len(boxes)} boxes")
    mine, theirs = ego[matches[:, 0]], other[matches[:, 1]]
    known = (mine.size[:, 2] > 0) & (theirs.size[:, 2] > 0)
    return theirs.center[known], mine.center[known, 2]


def _heights(state: FloatArray, points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """(N,) heights in the ego frame [m] of (N, 3) points of the other's, and their (N, 3) derivatives by the state."""
    z, roll, pitch = state
    sin_roll, cos_roll, sin_pitch, cos_pitch = math.sin(roll), math.cos(roll), math.sin(pitch), math.cos(pitch)
    x, up = points[:, 0], sin_roll * points[:, 1] + cos_roll * points[:, 2]
    across = cos_roll * points[:, 1] - sin_roll * points[:, 2]
    jacobian = np.column_stack([np.ones(len(points)), cos_pitch * across, -cos_pitch * x - sin_pitch * up])
    return z - sin_pitch * x + cos_pitch * up, jacobian


def _fit(
    points: FloatArray,
    heights: FloatArray,
    mean: FloatArray,
    covariance: FloatArray,
    config: LevellingConfig,
    correlation: float,
) -> tuple[FloatArray, FloatArray]:
    """The state (z, roll, pitch) and its covariance: of the prior (`mean`, `covariance`) and the (K,) heights.

    Args:
        points: (K, 3) in the other's frame [m].
        heights: (K,) of them in the ego frame [m].
        mean: (3,) of the prior.
        covariance: (3, 3) of the prior.
        config: the settings.
        correlation: the information of each height is divided by this.
    """
    if len(points) == 0:
        return mean, covariance
    prior = np.linalg.inv(covariance)
    state, scale = mean, np.inf
    for _ in range(_MOST_ROUNDS):
        predicted, jacobian = _heights(state, points)
        residual = (heights - predicted) / config.height_std
        weight = (1.0 + residual**2 / scale) ** -2 / (correlation * config.height_std**2)
        information = prior + (jacobian.T * weight) @ jacobian
        pull = jacobian.T @ (weight * residual * config.height_std) + prior @ (mean - state)
        step = np.linalg.solve(information, pull)
        state = state + step
        if scale == config.outlier**2 and np.abs(step).max() < 1e-9:
            break
        largest = float(residual @ residual) if scale == np.inf else scale
        scale = max(config.outlier**2, 0.5 * largest)
    return state, np.asarray(np.linalg.inv(information), dtype=np.float64)
