"""Checks of the fields that standard messages have in common."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.messages.object_message import MessageError, ObjectMessage
from cobevglue.typing import ArrayLike, FloatArray, IntArray

__all__ = [
    "check_range",
    "check_station_id",
    "column",
    "rounded",
    "sent_ids",
    "station_id_of",
    "whole_bytes",
    "whole_units",
]


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


def check_station_id(value: Any) -> None:
    """MessageError if the value is no whole number of 32 bits."""
    if isinstance(value, bool) or not isinstance(value, (int, np.integer)):
        raise MessageError(f"station_id must be a whole number, got {value!r}")
    check_range("station_id", value, 0, 2**32 - 1)


def station_id_of(message: ObjectMessage) -> int:
    """The agent id of an object message as a number; MessageError if it is none."""
    if not (message.agent_id.isascii() and message.agent_id.isdigit()):
        raise MessageError(f"agent_id must be a station id, 0 to 2^32 - 1, got {message.agent_id!r}")
    return int(message.agent_id)


def whole_units(name: str, values: FloatArray, unit: float, limit: int, holder: str) -> IntArray:
    """Values in whole units; MessageError if one is beyond the limit of the holder, a message."""
    units = rounded(np.clip(values / unit, -2.0 * limit, 2.0 * limit))
    beyond = ~np.isfinite(values) | (np.abs(units) > limit)
    if beyond.any():
        row = int(beyond.reshape(len(values), -1).any(axis=1).argmax())
        raise MessageError(f"{name}: row {row} is {values[row].tolist()}, {holder} holds at most {limit * unit:g}")
    return units


def rounded(values: FloatArray) -> IntArray:
    """To the nearest whole number, 0 for NaN."""
    units: IntArray = np.nan_to_num(np.rint(values)).astype(np.int64)
    return units
