"""Anchors: encoding and decoding of boxes relative to them, and assignment of targets.

After SECOND (Yan et al., Sensors 2018), section 3.2. In numpy, for use in data-loader workers.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from cobevglue.perception.config import STRIDES, PointPillarsConfig
from cobevglue.se2 import wrap_angle
from cobevglue.typing import ArrayLike, BoolArray, Float32Array, FloatArray, IntArray

__all__ = ["AnchorGrid", "Targets", "assign_targets"]

_MAX_SIZE_RESIDUAL = 3.0
"""Size residuals are clipped here when decoded: no box is more than e^3 = 20 times its anchor."""
_DISTANCE_PENALTY = 1e-4
"""Penalty per metre of centre distance, subtracted from the IoU: breaks ties of anchors that contain a small object."""


class AnchorGrid:
    """The N = rows x columns x types anchors of a configuration, and boxes encoded relative to them.

    A box (x, y, z, l, w, h, yaw) relative to anchor a is encoded by seven residuals,

        (x - x_a) / d,  (y - y_a) / d,  (z - z_a) / h_a,  log(l / l_a),  log(w / w_a),  log(h / h_a),  yaw - yaw_a

    with d the horizontal diagonal of the anchor. The last is taken modulo pi, in (-pi/2, pi/2], and the direction is 0
    if the box faces along the anchor, or 1 if against it. SECOND separates directions at a fixed angle, where two
    almost equal headings get opposite labels. Relative to an assigned anchor, the nearest of 0 and 90 degrees, the
    yaw difference does not reach the boundary.

    Attributes:
        rows: cells along y, from y_min.
        columns: cells along x, from x_min.
        cell: side of a cell [m].
        origin: (2,) x_min and y_min [m].
        size: (T, 3) length, width, height of the types [m].
        yaw: (T,) [rad].
        z: (T,) height of the centre [m].
    """

    def __init__(self, config: PointPillarsConfig) -> None:
        self.config = config
        self.rows, self.columns, self.types = config.head_shape
        self.cell = config.pillar * STRIDES[0]
        self.origin = np.array([config.x_range[0], config.y_range[0]])
        self.size = np.repeat([[a.length, a.width, a.height] for a in config.anchors], 2, axis=0)
        self.yaw = np.tile([0.0, math.pi / 2], len(config.anchors))
        self.z = np.repeat([a.z for a in config.anchors], 2)

    def __len__(self) -> int:
        return self.rows * self.columns * self.types

    @property
    def extent(self) -> FloatArray:
        """(T, 2) sides of the types along x and y [m]."""
        rotated = self.yaw[:, None] > 0
        extent: FloatArray = np.where(rotated, self.size[:, 1::-1], self.size[:, :2])
        return extent

    @property
    def diagonal(self) -> FloatArray:
        """(T,) horizontal diagonals of the types [m]."""
        diagonal: FloatArray = np.hypot(self.size[:, 0], self.size[:, 1])
        return diagonal

    def boxes(self, index: ArrayLike) -> FloatArray:
        """(P, 7) x, y, z, l, w, h, yaw of these anchors (P,)."""
        cell, kind = np.divmod(np.asarray(index, dtype=np.int64), self.types)
        row, column = np.divmod(cell, self.columns)
        x, y = (self.origin + (np.stack([column, row], axis=-1) + 0.5) * self.cell).T
        return np.column_stack([x, y, self.z[kind], self.size[kind], self.yaw[kind]])

    def encode(self, boxes: FloatArray, index: ArrayLike) -> tuple[FloatArray, IntArray]:
        """Encode boxes (P, 7) relative to anchors `index` (P,) as residuals (P, 7) and directions (P,)."""
        anchors = self.boxes(index)
        diagonal = np.hypot(anchors[:, 3], anchors[:, 4])[:, None]
        turn = wrap_angle(boxes[:, 6] - anchors[:, 6])
        axis = _half_turn(turn)
        against = np.abs(turn - axis) > math.pi / 2
        residuals = np.column_stack(
            [
                (boxes[:, :2] - anchors[:, :2]) / diagonal,
                (boxes[:, 2] - anchors[:, 2]) / anchors[:, 5],
                np.log(boxes[:, 3:6] / anchors[:, 3:6]),
                axis,
            ]
        )
        return residuals, against.astype(np.int64)

    def decode(self, residuals: ArrayLike, direction: ArrayLike, index: ArrayLike) -> FloatArray:
        """Decode residuals (P, 7) and directions (P,) of anchors `index` (P,) to boxes (P, 7); yaw in [-pi, pi)."""
        anchors = self.boxes(index)
        values = np.asarray(residuals, dtype=np.float64)
        diagonal = np.hypot(anchors[:, 3], anchors[:, 4])[:, None]
        return np.column_stack(
            [
                anchors[:, :2] + values[:, :2] * diagonal,
                anchors[:, 2] + values[:, 2] * anchors[:, 5],
                anchors[:, 3:6] * np.exp(np.clip(values[:, 3:6], -_MAX_SIZE_RESIDUAL, _MAX_SIZE_RESIDUAL)),
                wrap_angle(anchors[:, 6] + _half_turn(values[:, 6]) + math.pi * np.asarray(direction)),
            ]
        )


@dataclass(frozen=True, slots=True, eq=False)
class Targets:
    """Targets of the head for one cloud; all other anchors are background.

    Attributes:
        positive: (P,) anchors with an assigned object, ascending.
        residuals: (P, 7) float32; see `AnchorGrid`.
        direction: (P,) 0 or 1.
        ignored: (I,) anchors that are neither positive nor background.
    """

    positive: IntArray
    residuals: Float32Array
    direction: IntArray
    ignored: IntArray


def assign_targets(boxes: ArrayLike, ignore: ArrayLike, anchors: AnchorGrid) -> Targets:
    """Assign objects to anchors by IoU.

    The IoU is computed with headings rounded to the nearest of 0 and 90 degrees, as in SECOND: axis-aligned boxes are
    fast to compare, and the assignment does not depend on the rotation. An object without an anchor of sufficient IoU
    is assigned to the best one, so that motorcycles are learnt, too.

    Args:
        boxes: (K, 7) x, y, z, l, w, h [m], yaw [rad] in the LiDAR's frame.
        ignore: (K,) True for objects that are not targets, for instance with too few points. Anchors around these and
            around objects with a centre out of range are ignored instead of background.
        anchors: the grid.

    Raises:
        ValueError: wrong shapes, or boxes with non-finite values or sizes that are not positive.
    """
    boxes = np.asarray(boxes, dtype=np.float64).reshape(-1, 7) if np.size(boxes) == 0 else np.asarray(boxes, np.float64)
    ignore = np.asarray(ignore, dtype=bool)
    if boxes.ndim != 2 or boxes.shape[1] != 7 or ignore.shape != boxes.shape[:1]:
        raise ValueError(f"boxes and ignore must have shapes (K, 7) and (K,), got {boxes.shape} and {ignore.shape}")
    bad = ~np.isfinite(boxes).all(axis=1) | ~(boxes[:, 3:6] > 0).all(axis=1)
    if bad.any():
        raise ValueError(f"boxes: row {int(bad.argmax())} is not finite or has no size: {boxes[bad.argmax()].tolist()}")

    config = anchors.config
    pairs = _overlaps(boxes, anchors)
    center = (boxes[:, :2] - anchors.origin) / anchors.cell
    ignore = ignore | (center < 0).any(axis=1) | (center >= [anchors.columns, anchors.rows]).any(axis=1)

    best, owner = np.zeros(len(anchors)), np.full(len(anchors), -1)
    near = np.flatnonzero(~ignore[pairs.box] & (pairs.iou >= config.negative_iou))
    near = near[np.argsort(pairs.iou[near], kind="stable")]  # ascending: the best overwrites the others
    best[pairs.anchor[near]] = pairs.iou[near]
    owner[pairs.anchor[near]] = pairs.box[near]
    owner[best < config.positive_iou] = -1
    not_background = best >= config.negative_iou
    _assign_remaining(owner, pairs, ~ignore)
    not_background[pairs.anchor[ignore[pairs.box] & (pairs.iou >= config.ignore_iou)]] = True

    positive = np.flatnonzero(owner >= 0)
    residuals, direction = anchors.encode(boxes[owner[positive]], positive)
    ignored = np.flatnonzero(not_background & (owner < 0)).astype(np.int64)
    return Targets(positive, residuals.astype(np.float32), direction, ignored)


@dataclass(frozen=True, slots=True, eq=False)
class _Pairs:
    """P overlapping pairs of a box and an anchor, ascending by box: indices, IoU, distance of the centres [m]."""

    box: IntArray
    anchor: IntArray
    iou: FloatArray
    distance: FloatArray


def _overlaps(boxes: FloatArray, anchors: AnchorGrid) -> _Pairs:
    """All overlapping pairs. The overlap along x depends only on the column, along y only on the row."""
    rotated = np.abs(np.sin(boxes[:, 6])) > math.sqrt(0.5)
    side = np.where(rotated[:, None], boxes[:, 4:2:-1], boxes[:, 3:5])  # (K, 2) along x and y
    reach = (side.max(initial=0.0) + anchors.extent.max()) / 2
    half = min(math.ceil(reach / anchors.cell), max(anchors.rows, anchors.columns)) + 1
    limits = anchors.origin, anchors.origin + np.array([anchors.columns, anchors.rows]) * anchors.cell
    inside = np.flatnonzero(((boxes[:, :2] > limits[0] - reach) & (boxes[:, :2] < limits[1] + reach)).all(axis=1))
    boxes, side = boxes[inside], side[inside]

    lines, offsets, shared = [], [], []
    for axis, count in ((0, anchors.columns), (1, anchors.rows)):
        first = np.floor((boxes[:, axis] - anchors.origin[axis]) / anchors.cell).astype(np.int64)
        line = first[:, None] + np.arange(-half, half + 1)  # (K, W) columns or rows around the box
        offset = anchors.origin[axis] + (line + 0.5) * anchors.cell - boxes[:, axis, None]
        a, b = side[:, None, axis, None] / 2, anchors.extent[None, :, axis, None] / 2
        both = np.minimum(a, offset[:, None] + b) - np.maximum(-a, offset[:, None] - b)  # (K, T, W)
        shared.append(np.clip(both, 0.0, None) * ((line >= 0) & (line < count))[:, None])
        lines.append(line)
        offsets.append(offset)

    inter = shared[1][..., None] * shared[0][:, :, None]  # (K, T, W rows, W columns)
    k, t, r, c = np.nonzero(inter)
    inter = inter[k, t, r, c]
    iou = inter / (side.prod(axis=1)[k] + anchors.extent.prod(axis=1)[t] - inter)
    index = (lines[1][k, r] * anchors.columns + lines[0][k, c]) * anchors.types + t
    return _Pairs(inside[k], index, iou, np.hypot(offsets[0][k, c], offsets[1][k, r]))


def _assign_remaining(owner: IntArray, pairs: _Pairs, targets: BoolArray) -> None:
    """Assign each target without an anchor to its best free one, in place; targets with the best fit come first."""
    remaining = targets.copy()
    remaining[owner[owner >= 0]] = False
    quality = pairs.iou - _DISTANCE_PENALTY * pairs.distance
    first = np.searchsorted(pairs.box, np.arange(len(targets) + 1))
    rows_of = {
        box: np.arange(first[box], first[box + 1]) for box in np.flatnonzero(remaining) if first[box] < first[box + 1]
    }
    for box in sorted(rows_of, key=lambda box: -quality[rows_of[box]].max()):
        rows = rows_of[box][owner[pairs.anchor[rows_of[box]]] < 0]
        if len(rows):
            owner[pairs.anchor[rows[quality[rows].argmax()]]] = box


def _half_turn(angle: FloatArray) -> FloatArray:
    """Angles modulo pi, in (-pi/2, pi/2]."""
    return angle - math.pi * np.ceil(angle / math.pi - 0.5)
