"""Boxes as the rows of numbers that the numba kernels take."""

from __future__ import annotations

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.typing import FloatArray, IntArray

__all__ = ["box_rows", "track_ids"]

_NO_IDS = np.zeros(0, np.int64)
_NO_IDS.setflags(write=False)  # like the arrays of `Boxes`: numba compiles for one kind of array only


def box_rows(boxes: Boxes) -> FloatArray:
    """(N, 7) x, y, length, width, yaw [m, rad] and a velocity of 0 [m/s]."""
    rows = np.zeros((len(boxes), 7))
    rows[:, :2] = boxes.center[:, :2]
    rows[:, 2:4] = boxes.size[:, :2]
    rows[:, 4] = boxes.yaw
    return rows


def track_ids(boxes: Boxes) -> IntArray:
    """(N,) track ids, or (0,) if there are none."""
    return _NO_IDS if boxes.track_id is None else boxes.track_id
