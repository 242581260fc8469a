"""Named arrays as bytes: the encoding of feature maps, points, scored boxes and poses.

Layout of version 1, little endian throughout:

| bytes | type    | content                                            |
|-------|---------|----------------------------------------------------|
| 4     | bytes   | magic, `CBVA`                                      |
| 1     | uint8   | version, 1                                         |
| 1     | uint8   | number of arrays                                   |
| 4     | uint32  | after the arrays: CRC-32 (zlib's) of all before it |

and of each array: length of its name (uint8), the name (UTF-8), type (uint8), number of dimensions (uint8), shape
(uint32 each), and the numbers in C order.

The length of the encoded bytes is the communication volume of the data shared for fusion. The sender chooses the types
(for example float16 for features); the arrays are not compressed.
"""

from __future__ import annotations

import math
import struct
import zlib
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cobevglue.messages.object_message import MessageError

__all__ = ["Arrays", "decode_arrays", "encode_arrays"]

Arrays = Mapping[str, NDArray[Any]]
"""Arrays by name."""

_MAGIC, _VERSION = b"CBVA", 1
_HEADER = struct.Struct("<4sBB")
_CHECKSUM = struct.Struct("<I")
_TYPES = [np.dtype(name) for name in ("<f2", "<f4", "<f8", "u1", "<u2", "<u4", "i1", "<i2", "<i4", "<i8")]


def encode_arrays(arrays: Arrays) -> bytes:
    """Encode arrays in the layout described in this module's docstring.

    Raises:
        MessageError: more than 255 arrays, a name that is empty or longer than 255 bytes, or an unsupported type.
    """
    if len(arrays) > 255:
        raise MessageError(f"{len(arrays)} arrays, a message holds at most 255")
    parts = [_HEADER.pack(_MAGIC, _VERSION, len(arrays))]
    for name, array in arrays.items():
        text = name.encode("utf-8")
        dtype = array.dtype.newbyteorder("<") if array.dtype.byteorder == ">" else array.dtype
        if dtype not in _TYPES or not 1 <= len(text) <= 255 or array.ndim > 255:
            raise MessageError(f"array {name!r} of {array.dtype} with {array.ndim} dimensions cannot be encoded")
        shape = struct.pack(f"<BB{array.ndim}I", _TYPES.index(dtype), array.ndim, *array.shape)
        parts += [bytes([len(text)]), text, shape, np.ascontiguousarray(array, dtype).tobytes()]
    body = b"".join(parts)
    return body + _CHECKSUM.pack(zlib.crc32(body))


def decode_arrays(data: bytes) -> dict[str, NDArray[Any]]:
    """Decode a message into arrays by name; the arrays are read-only.

    Raises:
        MessageError: the bytes are not exactly one intact message of a known version.
    """
    end = len(data) - _CHECKSUM.size
    if end < _HEADER.size:
        raise MessageError(f"truncated: {len(data)} bytes, a message has at least {_HEADER.size + _CHECKSUM.size}")
    magic, version, count = _HEADER.unpack_from(data)
    if magic != _MAGIC or version != _VERSION:
        raise MessageError(f"not an array message of version {_VERSION}: it starts with {data[:5]!r}")
    if zlib.crc32(data[:end]) != _CHECKSUM.unpack_from(data, end)[0]:
        raise MessageError("corrupted: the checksum does not match")
    try:
        arrays, offset = _read(data[:end], count)
    except (struct.error, IndexError, UnicodeDecodeError, ValueError) as error:
        raise MessageError(f"invalid: {error}") from None
    if offset != end or len(arrays) != count:
        raise MessageError("invalid: bytes left over, or two arrays of one name")
    return arrays


def _read(data: bytes, count: int) -> tuple[dict[str, NDArray[Any]], int]:
    arrays: dict[str, NDArray[Any]] = {}
    offset = _HEADER.size
    for _ in range(count):
        length = data[offset]
        name = data[offset + 1 : offset + 1 + length].decode("utf-8")
        offset += 1 + length
        kind, dimensions = struct.unpack_from("<BB", data, offset)
        shape = struct.unpack_from(f"<{dimensions}I", data, offset + 2)
        offset += 2 + 4 * dimensions
        size = math.prod(shape)
        array = np.frombuffer(data, _TYPES[kind], count=size, offset=offset) if size else np.zeros(0, _TYPES[kind])
        arrays[name] = array.reshape(shape)
        offset += array.nbytes
    return arrays, offset
