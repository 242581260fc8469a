"""Compiled inner loops of `cobevglue.iou`; importing this module imports numba, so `iou` does it on first use.

A pair is computed in the frame of its first box: there that box is |x| <= l/2, |y| <= w/2, so clipping the second box
against it (Sutherland and Hodgman, 1974) is four cuts along the axes, and coordinates stay small wherever in the world
the boxes are. Rows are x, y, length, width, yaw, as `Boxes.bev` gives them.
"""

from __future__ import annotations

import math

import numpy as np

from cobevglue._kernels import kernel
from cobevglue.typing import FloatArray, IntArray

_SCRATCH = 20
"""Corners that fit: four cuts make at most 8 of a quadrilateral, and at most 4 * 1.5^4 whatever rounding does."""


@kernel()
def iou_matrix(a: FloatArray, b: FloatArray) -> FloatArray:
    """(N, M) intersection over union of every row of `a` with every row of `b`."""
    iou = np.zeros((len(a), len(b)))
    polygon, clipped = np.empty((_SCRATCH, 2)), np.empty((_SCRATCH, 2))
    reach_a, reach_b = _circumradius(a), _circumradius(b)
    for i in range(len(a)):
        for j in range(len(b)):
            reach = reach_a[i] + reach_b[j]
            if (a[i, 0] - b[j, 0]) ** 2 + (a[i, 1] - b[j, 1]) ** 2 < reach * reach:
                iou[i, j] = _iou(a[i], b[j], polygon, clipped)
    return iou


@kernel()
def giou_matrix(a: FloatArray, b: FloatArray, max_distance: float) -> FloatArray:
    """(N, M) generalised IoU; -1 for pairs whose centres are further apart than `max_distance`."""
    giou = np.full((len(a), len(b)), -1.0)
    polygon, clipped = np.empty((_SCRATCH, 2)), np.empty((_SCRATCH, 2))
    points, hull = np.empty((8, 2)), np.empty((17, 2))
    for i in range(len(a)):
        for j in range(len(b)):
            if (a[i, 0] - b[j, 0]) ** 2 + (a[i, 1] - b[j, 1]) ** 2 <= max_distance * max_distance:
                iou = _iou(a[i], b[j], polygon, clipped)
                union = (a[i, 2] * a[i, 3] + b[j, 2] * b[j, 3]) / (1.0 + iou)
                enclosing = max(_hull_area(a[i], b[j], points, hull), union)
                giou[i, j] = iou - (enclosing - union) / enclosing
    return giou


@kernel()
def greedy_nms(boxes: FloatArray, order: IntArray, iou_threshold: float) -> IntArray:
    """The rows of `order` that overlap no earlier kept row by more than the threshold, in that order."""
    kept = np.empty(len(order), dtype=np.int64)
    n_kept = 0
    polygon, clipped = np.empty((_SCRATCH, 2)), np.empty((_SCRATCH, 2))
    radius = _circumradius(boxes)
    for i in order:
        alone = True
        for k in range(n_kept):
            j = kept[k]
            reach = radius[i] + radius[j]
            if (boxes[i, 0] - boxes[j, 0]) ** 2 + (boxes[i, 1] - boxes[j, 1]) ** 2 < reach * reach and _iou(
                boxes[j], boxes[i], polygon, clipped
            ) > iou_threshold:
                alone = False
                break
        if alone:
            kept[n_kept] = i
            n_kept += 1
    return kept[:n_kept].copy()


@kernel()
def _circumradius(boxes: FloatArray) -> FloatArray:
    """(N,) radius of the circle around each box: two boxes whose circles are apart cannot overlap."""
    radius: FloatArray = 0.5 * np.sqrt(boxes[:, 2] ** 2 + boxes[:, 3] ** 2)
    return radius


@kernel()
def _corners_in_frame_of(a: FloatArray, b: FloatArray, corners: FloatArray) -> None:
    """Write the corners of `b`, counter-clockwise, in the frame of `a` into the first four rows of `corners`."""
    cos_a, sin_a = math.cos(a[4]), math.sin(a[4])
    dx, dy = b[0] - a[0], b[1] - a[1]
    x, y = cos_a * dx + sin_a * dy, cos_a * dy - sin_a * dx
    cos_d, sin_d = math.cos(b[4] - a[4]), math.sin(b[4] - a[4])
    lx, ly = 0.5 * b[2] * cos_d, 0.5 * b[2] * sin_d
    wx, wy = -0.5 * b[3] * sin_d, 0.5 * b[3] * cos_d
    corners[0, 0], corners[0, 1] = x + lx + wx, y + ly + wy
    corners[1, 0], corners[1, 1] = x - lx + wx, y - ly + wy
    corners[2, 0], corners[2, 1] = x - lx - wx, y - ly - wy
    corners[3, 0], corners[3, 1] = x + lx - wx, y + ly - wy


@kernel()
def _iou(a: FloatArray, b: FloatArray, polygon: FloatArray, clipped: FloatArray) -> float:
    """IoU of two boxes; `polygon` and `clipped` (_SCRATCH, 2) are overwritten."""
    _corners_in_frame_of(a, b, polygon)
    n = 4
    for axis in range(2):
        half = 0.5 * a[2 + axis]
        lowest, highest = polygon[0, axis], polygon[0, axis]
        for k in range(1, n):
            lowest, highest = min(lowest, polygon[k, axis]), max(highest, polygon[k, axis])
        if lowest >= half or highest <= -half:
            return 0.0
        if highest > half:
            n = _cut(polygon, n, axis, 1.0, half, clipped)
            polygon, clipped = clipped, polygon
        if lowest < -half:
            n = _cut(polygon, n, axis, -1.0, half, clipped)
            polygon, clipped = clipped, polygon
    intersection = _area(polygon, n)
    union = a[2] * a[3] + b[2] * b[3] - intersection
    iou: float = min(max(intersection / union, 0.0), 1.0)
    return iou


@kernel()
def _cut(polygon: FloatArray, n: int, axis: int, sign: float, limit: float, out: FloatArray) -> int:
    """Keep the part of a convex polygon where sign * coordinate <= limit; returns its number of corners."""
    other = 1 - axis
    count = 0
    previous = n - 1
    before = sign * polygon[previous, axis] - limit
    for k in range(n):
        after = sign * polygon[k, axis] - limit
        if (before < 0.0 < after) or (after < 0.0 < before):
            t = before / (before - after)
            out[count, axis] = sign * limit
            out[count, other] = polygon[previous, other] + t * (polygon[k, other] - polygon[previous, other])
            count += 1
        if after <= 0.0:
            out[count, 0], out[count, 1] = polygon[k, 0], polygon[k, 1]
            count += 1
        previous, before = k, after
    return count


@kernel()
def _area(polygon: FloatArray, n: int) -> float:
    """Area of the first `n` corners, counter-clockwise (shoelace)."""
    twice = 0.0
    for k in range(n):
        following = k + 1 if k + 1 < n else 0
        twice += polygon[k, 0] * polygon[following, 1] - polygon[k, 1] * polygon[following, 0]
    return 0.5 * twice


@kernel()
def _hull_area(a: FloatArray, b: FloatArray, points: FloatArray, hull: FloatArray) -> float:
    """Area of the convex hull of two boxes (Andrew's monotone chain); `points` (8, 2), `hull` (17, 2) are scratch."""
    _corners_in_frame_of(a, b, points)
    for k in range(4):
        points[4 + k, 0] = 0.5 * a[2] if k in (0, 3) else -0.5 * a[2]
        points[4 + k, 1] = 0.5 * a[3] if k in (0, 1) else -0.5 * a[3]
    for k in range(1, 8):  # insertion sort by x, then y
        x, y = points[k, 0], points[k, 1]
        i = k
        while i > 0 and (points[i - 1, 0] > x or (points[i - 1, 0] == x and points[i - 1, 1] > y)):
            points[i, 0], points[i, 1] = points[i - 1, 0], points[i - 1, 1]
            i -= 1
        points[i, 0], points[i, 1] = x, y
    n = 0
    for side in range(2):  # the lower chain from left to right, then the upper one back
        first = n
        for step in range(8):
            k = step if side == 0 else 7 - step
            x, y = points[k, 0], points[k, 1]
            while n >= first + 2:
                ux, uy = hull[n - 1, 0] - hull[n - 2, 0], hull[n - 1, 1] - hull[n - 2, 1]
                if ux * (y - hull[n - 2, 1]) - uy * (x - hull[n - 2, 0]) > 0.0:
                    break
                n -= 1
            hull[n, 0], hull[n, 1] = x, y
            n += 1
        n -= 1  # each chain ends where the other begins
    return _area(hull, n)
