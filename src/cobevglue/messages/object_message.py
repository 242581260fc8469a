"""The message that an agent sends in each frame: a header and eight numbers per object, as in the paper.

Layout of version 2, little endian throughout, A = length of the agent id in bytes, N = number of objects:

| offset   | bytes | type    | content                                                                     |
|----------|-------|---------|-----------------------------------------------------------------------------|
| 0        | 4     | bytes   | magic, `CBVG`                                                               |
| 4        | 1     | uint8   | version, 2                                                                  |
| 5        | 1     | uint8   | A, 1 to 64                                                                  |
| 6        | 2     | uint16  | N, 0 to 4096                                                                |
| 8        | 4     | uint32  | frame: the sender's frame count                                             |
| 12       | 8     | float64 | time stamp [s]                                                              |
| 20       | 16    | float64 | origin x, y [m] of the objects in the sender's frame                        |
| 36       | A     | UTF-8   | agent id, printable characters                                              |
| 36+A     | 32 N  | float32 | per object x, y from the origin, z, l, w, h [m], yaw [rad], and track id    |
| 36+A+32N | 4     | uint32  | CRC-32 (zlib's) of all bytes before it                                      |

Version 1 has no origin: the agent id is at offset 20, and x and y are in the sender's frame. Version 1 can be decoded,
but only version 2 is encoded.

- The origin keeps float32 accurate in map coordinates: float32 resolves 0.5 mm only up to 16 km, but a northing in UTM
  can be 5,000 km. The origin is the median position, rounded to multiples of 1,024 m, and so 0 in the frame of a
  vehicle. A coordinate whose rounding error exceeds 1 mm is rejected.
- Scores and labels are not sent: the paper sends eight numbers per object, and alignment does not need more.
- The box of the sender's own vehicle, if sent, is the last object, with -2 in place of the track id.
- Track ids are integers from 0 to 2^24, which float32 represents exactly. Boxes without track ids have -1 in every row
  except that of the own vehicle; -1 in only some of these rows is an error. A message without objects decodes to boxes
  without track ids.
- A yaw outside [-pi, pi] is wrapped into this interval before rounding to float32, which preserves its precision.
- The CRC detects corruption (including every single flipped bit), but not forgery: messages are not authenticated.

The length of the encoded bytes is the communication volume of the boxes in all reported results.
"""

from __future__ import annotations

import math
import struct
import zlib
from dataclasses import dataclass

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.se2 import wrap_angle
from cobevglue.typing import Float32Array, FloatArray, IntArray

__all__ = [
    "BYTES_PER_OBJECT",
    "MAX_AGENT_ID_BYTES",
    "MAX_OBJECTS",
    "MAX_TRACK_ID",
    "VERSION",
    "MessageError",
    "ObjectMessage",
    "decode",
    "encode",
    "encoded_size",
]

VERSION = 2
"""Version that is encoded; version 1 can be decoded as well."""
MAX_OBJECTS = 4096
"""Maximum number of objects in one message, far more than any scene has; it limits a message to 131,176 bytes."""
MAX_AGENT_ID_BYTES = 64
"""Maximum length of an agent id in UTF-8 [bytes]."""
MAX_TRACK_ID = 2**24
"""Largest track id: float32 represents every integer up to this one exactly."""
MAX_FRAME = 2**32 - 1
"""Largest frame count, reached after 13 years at 10 Hz."""
BYTES_PER_OBJECT = 32
"""Encoded size of one object: eight float32 numbers [bytes]."""

_MAGIC = b"CBVG"
_HEADER = struct.Struct("<4sBBHId")
_ORIGIN = struct.Struct("<2d")
_ORIGIN_GRID = 1024.0  # origins are multiples of this [m]
_TOLERANCE = 1e-3  # largest position error after encoding and decoding [m]
_CHECKSUM = struct.Struct("<I")
_NO_TRACK_ID, _OWN_VEHICLE = -1, -2
_LARGEST_YAW = np.float32(np.pi)  # slightly above pi: the float32 value to which angles near pi are rounded


class MessageError(ValueError):
    """A message that cannot be encoded, or bytes that are not a complete, intact message of a known version."""


@dataclass(frozen=True, eq=False, slots=True)
class ObjectMessage:
    """Objects that one agent observed at one time.

    Attributes:
        agent_id: the sender; printable characters, 1 to 64 bytes of UTF-8.
        time: time stamp of the boxes [s], finite.
        frame: the sender's frame count, 0 to 2^32 - 1.
        boxes: the objects, in the sender's own LiDAR frame. Scores and labels are not encoded.
        body: one-row box of the sender's own vehicle in the same frame, or None.

    Raises:
        MessageError: a field is out of range; the error names the field.
    """

    agent_id: str
    time: float
    frame: int
    boxes: Boxes
    body: Boxes | None = None

    def __post_init__(self) -> None:
        _agent_id_bytes(self.agent_id)
        if not isinstance(self.time, (int, float, np.number)) or not math.isfinite(self.time):
            raise MessageError(f"time must be a finite number of seconds, got {self.time!r}")
        if not isinstance(self.frame, (int, np.integer)) or isinstance(self.frame, bool):
            raise MessageError(f"frame must be a whole number, got {self.frame!r}")
        if not 0 <= self.frame <= MAX_FRAME:
            raise MessageError(f"frame must be from 0 to {MAX_FRAME}, got {self.frame}")
        if not isinstance(self.boxes, Boxes):
            raise MessageError(f"boxes must be Boxes, got {type(self.boxes).__name__}")
        if self.body is not None and (not isinstance(self.body, Boxes) or len(self.body) != 1):
            raise MessageError(f"body must be Boxes with one row, got {self.body!r}")
        if _count(self) > MAX_OBJECTS:
            raise MessageError(f"boxes: {_count(self)} objects, a message holds at most {MAX_OBJECTS}")
        object.__setattr__(self, "time", float(self.time))
        object.__setattr__(self, "frame", int(self.frame))


def encoded_size(n_objects: int, agent_id: str) -> int:
    """Return the encoded size of a message [bytes], without encoding it.

    The sender's own vehicle, if sent, counts as one of the `n_objects`.

    Raises:
        MessageError: too many objects, or an invalid agent id.
    """
    if not 0 <= n_objects <= MAX_OBJECTS:
        raise MessageError(f"n_objects must be from 0 to {MAX_OBJECTS}, got {n_objects}")
    return _size(VERSION, len(_agent_id_bytes(agent_id)), n_objects)


def encode(message: ObjectMessage) -> bytes:
    """Encode a message in the layout described in this module's docstring.

    Raises:
        MessageError: a track id is negative or above 2^24, the rounding error of a position exceeds 1 mm (objects more
            than 16 km apart), or a size is zero or infinite in float32; the error names field and row. Every message
            that is encoded can be decoded.
    """
    agent_id = _agent_id_bytes(message.agent_id)
    origin = _origin_of(message.boxes)
    table = _checked_table(message.boxes, origin, "boxes")
    if message.body is not None:
        row = _checked_table(message.body.replace(track_id=None), origin, "body")
        row[0, 7] = _OWN_VEHICLE
        table = np.concatenate([table, row])
    header = _HEADER.pack(_MAGIC, VERSION, len(agent_id), _count(message), message.frame, message.time)
    body = header + _ORIGIN.pack(*origin) + agent_id + table.tobytes()
    return body + _CHECKSUM.pack(zlib.crc32(body))


def decode(data: bytes | bytearray | memoryview) -> ObjectMessage:
    """Decode a message.

    Raises:
        MessageError: the bytes are not exactly one intact message of a known version with valid boxes; the error gives
            the reason.
    """
    if not isinstance(data, (bytes, bytearray, memoryview)):
        raise MessageError(f"a message is bytes, got {type(data).__name__}")
    data = bytes(data)
    smallest = _size(1, 1, 0)
    if len(data) < smallest:
        raise MessageError(f"truncated: {len(data)} bytes, a message has at least {smallest}")
    magic, version, id_length, n_objects, frame, time = _HEADER.unpack_from(data)
    if magic != _MAGIC:
        raise MessageError(f"not an object message: it starts with {magic!r} instead of {_MAGIC!r}")
    if not 1 <= version <= VERSION:
        raise MessageError(f"unknown version {version}, only versions 1 to {VERSION} can be read")
    if not 1 <= id_length <= MAX_AGENT_ID_BYTES or n_objects > MAX_OBJECTS:
        raise MessageError(
            f"corrupted: the header has an agent id of {id_length} bytes (1 to {MAX_AGENT_ID_BYTES}) and {n_objects} "
            f"objects (at most {MAX_OBJECTS})"
        )
    expected = _size(version, id_length, n_objects)
    objects_end = expected - _CHECKSUM.size
    objects_start = objects_end - BYTES_PER_OBJECT * n_objects
    if len(data) != expected:
        what = "truncated" if len(data) < expected else "oversized"
        raise MessageError(f"{what}: {len(data)} bytes, the header ({n_objects} objects) requires {expected}")
    if zlib.crc32(data[:objects_end]) != _CHECKSUM.unpack_from(data, objects_end)[0]:
        raise MessageError("corrupted: the checksum does not match")
    # The checksum matches, so any error found below was made by the sender.
    try:
        agent_id = data[objects_start - id_length : objects_start].decode("utf-8")
    except UnicodeDecodeError as error:
        raise MessageError(f"agent_id is not UTF-8: {error}") from None
    table = np.frombuffer(data, dtype="<f4", count=8 * n_objects, offset=objects_start).reshape(n_objects, 8)
    origin = np.array(_ORIGIN.unpack_from(data, _HEADER.size) if version > 1 else (0.0, 0.0))
    if not np.isfinite(origin).all():
        raise MessageError(f"origin must be finite, got {origin.tolist()}")
    has_body = version > 1 and n_objects > 0 and table[-1, 7] == _OWN_VEHICLE
    try:
        boxes = _boxes_of(table[:-1] if has_body else table, origin)
        body = _boxes_of(_without_track_id(table[-1:]), origin) if has_body else None
    except ValueError as error:
        raise MessageError(f"invalid boxes: {error}") from None
    return ObjectMessage(agent_id=agent_id, time=time, frame=frame, boxes=boxes, body=body)


def _count(message: ObjectMessage) -> int:
    """Return the number of objects in a message, including the own vehicle."""
    return len(message.boxes) + (message.body is not None)


def _size(version: int, id_length: int, n_objects: int) -> int:
    """Return the size of a message of this version [bytes]."""
    header = _HEADER.size + (_ORIGIN.size if version > 1 else 0)
    return header + id_length + BYTES_PER_OBJECT * n_objects + _CHECKSUM.size


def _agent_id_bytes(agent_id: str) -> bytes:
    """Encode an agent id as UTF-8. Ids must be printable, because logs, tables and file names contain them."""
    if not isinstance(agent_id, str):
        raise MessageError(f"agent_id must be a string, got {agent_id!r}")
    if not agent_id.isprintable():  # also refuses lone surrogates, which UTF-8 cannot hold
        raise MessageError(f"agent_id must be printable, got {agent_id!r}")
    encoded = agent_id.encode("utf-8")
    if not 1 <= len(encoded) <= MAX_AGENT_ID_BYTES:
        raise MessageError(f"agent_id must have 1 to {MAX_AGENT_ID_BYTES} bytes in UTF-8, got {len(encoded)}")
    return encoded


def _origin_of(boxes: Boxes) -> FloatArray:
    """Return the (2,) median position x, y [m], rounded to the grid of origins."""
    if not len(boxes):
        return np.zeros(2)
    median = np.sort(boxes.center[:, :2], axis=0)[(len(boxes) - 1) // 2]
    origin: FloatArray = np.round(median / _ORIGIN_GRID) * _ORIGIN_GRID + 0.0  # no negative zeros
    return origin


def _checked_table(boxes: Boxes, origin: FloatArray, name: str) -> Float32Array:
    """Return the table of the boxes; MessageError if float32 cannot represent them accurately."""
    table = _table_of(boxes, origin)
    try:
        arrived = _boxes_of(table, origin)  # a size rounded to zero or a coordinate rounded to infinity is invalid
    except ValueError as error:
        raise MessageError(f"{name} do not fit float32: {error}") from None
    error_m = np.abs(arrived.center - boxes.center).max(axis=1, initial=0.0)
    if (error_m > _TOLERANCE).any():
        row = int(error_m.argmax())
        raise MessageError(
            f"{name} do not fit float32: center: row {row} is {boxes.center[row].tolist()}, too far from the "
            f"other objects around {origin.tolist()}: its rounding error would be {error_m[row]:.2g} m"
        )
    return table


def _without_track_id(table: Float32Array) -> Float32Array:
    """Return a copy of the rows with -1 in place of the track id."""
    plain = table.copy()
    plain[:, 7] = _NO_TRACK_ID
    return plain


def _table_of(boxes: Boxes, origin: FloatArray) -> Float32Array:
    """Return (N, 8) little-endian float32: x and y relative to the origin, z, l, w, h, yaw, track id."""
    table = np.empty((len(boxes), 8), dtype="<f4")
    with np.errstate(over="ignore", under="ignore"):  # `_checked_table` reports overflow and underflow
        table[:, 0:2] = boxes.center[:, :2] - origin
        table[:, 2] = boxes.center[:, 2]
        table[:, 3:6] = boxes.size
        yaw = boxes.yaw.astype("<f4")
        table[:, 6] = np.where(np.abs(yaw) <= _LARGEST_YAW, yaw, wrap_angle(boxes.yaw))
    table[:, 7] = _NO_TRACK_ID if boxes.track_id is None else _sendable(boxes.track_id)
    return table


def _sendable(track_id: IntArray) -> IntArray:
    """Return the track ids; MessageError if one is not from 0 to 2^24."""
    wrong = (track_id < 0) | (track_id > MAX_TRACK_ID)
    if wrong.any():
        row = int(wrong.argmax())
        raise MessageError(
            f"track_id: row {row} is {track_id[row]}, a message holds ids from 0 to {MAX_TRACK_ID} (2^24)"
        )
    return track_id


def _boxes_of(sent: Float32Array, origin: FloatArray) -> Boxes:
    """Return the boxes of an (N, 8) table; ValueError with field and row if they are invalid."""
    with np.errstate(invalid="ignore"):  # a signalling NaN would warn here; `Boxes` rejects it
        table = sent.astype(np.float64)
    table[:, 0:2] += origin
    track_id = table[:, 7]
    absent = track_id == _NO_TRACK_ID
    if not absent.all():
        in_range = (track_id >= 0) & (track_id <= MAX_TRACK_ID) & (np.floor(track_id) == track_id)
        if not in_range.all():
            row = int((~in_range).argmax())
            raise ValueError(
                f"track_id: row {row} is {track_id[row]}; "
                f"ids are whole numbers from 0 to {MAX_TRACK_ID}, or -1 in all rows"
            )
    return Boxes(
        center=table[:, 0:3],
        size=table[:, 3:6],
        yaw=table[:, 6],
        track_id=None if absent.all() else track_id,
    )
