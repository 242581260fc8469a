"""Checks of the fields that standard messages have in common."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.messages.object_message import MessageError
from cobevglue.typing import ArrayLike, FloatArray, IntArray

__all__ = ["check_range", "column", "sent_ids", "whole_bytes"]


def whole_bytes(data: Any) -> bytes:
    """The data as bytes; MessageError if it is something else."""
    if not isinstance(data, (bytes, bytearray, memoryview)):
        raise MessageError(f"a message is bytes, got {type(data).__name__}")
    return bytes(data)


def sent_ids(boxes: Boxes, modulo: int) -> IntArray:
    """Track ids of the boxes modulo a number; MessageError if one is negative or two are the same."""
    ids = np.zeros(0, np.int64) if boxes.track_id is None else boxes.track_id
    if (ids < 0).any():
        raise MessageError(f"track_id: row {int((ids < 0).argmax())} is {int(ids.min())}, ids must be >= 0")
    ids = ids % modulo
    if len(np.unique(ids)) < len(ids):
        raise MessageError(f"track_id: two ids are the same modulo {modulo}")
    return ids


def check_range(name: str, value: Any, low: float, high: float) -> None:
    """MessageError if the value is no finite number in the range."""
    if isinstance(value, bool) or not isinstance(value, (int, float, np.number)) or not math.isfinite(value):
        raise MessageError(f"{name} must be a finite number, got {value!r}")
    if not low <= value <= high:
        raise MessageError(f"{name} must be from {low} to {high}, got {value}")


def column(name: str, values: ArrayLike, shape: tuple[int, ...]) -> FloatArray | None:
    """The values as an array of this shape, None for None."""
    if values is None:
        return None
    try:
        array = np.array(values, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise MessageError(f"{name} must be numbers of shape {shape}: {error}") from None
    if array.size == 0 and shape[0] == 0:
        array = array.reshape(shape)
    if array.shape != shape:
        raise MessageError(f"{name} must have shape {shape}, got {array.shape}")
    array.setflags(write=False)
    return array
