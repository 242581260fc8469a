"""Overlap of rotated boxes seen from above, and the non-maximum suppression built on it.

Exact polygon clipping in a compiled kernel. numba is imported by the first call, not by importing this module.
"""

from __future__ import annotations

import math

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.typing import FloatArray, IntArray

__all__ = ["bev_giou", "bev_iou", "nms"]


def bev_iou(a: Boxes, b: Boxes) -> FloatArray:
    """Intersection over union of every box of `a` with every box of `b`, seen from above.

    Heights, labels and scores play no part. Both sets are in the same frame; moving both together changes nothing.

    Args:
        a: N boxes.
        b: M boxes.

    Returns:
        (N, M) IoU in [0, 1]; touching boxes have 0.
    """
    from cobevglue._iou_kernels import iou_matrix

    return iou_matrix(a.bev, b.bev)


def bev_giou(a: Boxes, b: Boxes, max_distance: float = math.inf) -> FloatArray:
    """Generalised IoU (Rezatofighi et al., CVPR 2019) of every pair, seen from above.

    IoU minus the share of the two boxes' convex hull that neither covers, so that it still depends on the distance
    when boxes do not overlap.

    Args:
        a: N boxes.
        b: M boxes.
        max_distance: pairs whose centres are further apart [m] get -1 without further work.

    Returns:
        (N, M) in [-1, 1]; 1 is the same box, towards -1 is far apart.

    Raises:
        ValueError: `max_distance` is negative or NaN.
    """
    if not max_distance >= 0.0:
        raise ValueError(f"max_distance must be >= 0, got {max_distance}")
    from cobevglue._iou_kernels import giou_matrix

    return giou_matrix(a.bev, b.bev, float(max_distance))


def nms(boxes: Boxes, iou_threshold: float) -> IntArray:
    """Greedy non-maximum suppression on the rotated IoU seen from above; labels play no part.

    The best-scored box is kept, all that overlap it by more than the threshold are dropped, and so on. Equal scores go
    by row order.

    Args:
        boxes: N boxes with scores.
        iou_threshold: overlap up to which two boxes may both stay, in [0, 1].

    Returns:
        (K,) rows kept, best score first; `boxes[nms(boxes, 0.15)]` are the boxes.

    Raises:
        ValueError: the boxes have no scores, or the threshold is outside [0, 1].
    """
    if boxes.score is None:
        raise ValueError("score: nms needs boxes with scores, got None")
    if not 0.0 <= iou_threshold <= 1.0:
        raise ValueError(f"iou_threshold must be in [0, 1], got {iou_threshold}")
    from cobevglue._iou_kernels import greedy_nms

    return greedy_nms(boxes.bev, np.argsort(-boxes.score, kind="stable"), float(iou_threshold))
