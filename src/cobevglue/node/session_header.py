"""The header that a node sends beside each message: which run of the sender it is of, and its number in that run.

Layout of version 1, little endian, 21 bytes:

| offset | bytes | type   | content                                                                             |
|--------|-------|--------|-------------------------------------------------------------------------------------|
| 0      | 4     | bytes  | magic, `CBVS`                                                                       |
| 4      | 1     | uint8  | version, 1                                                                          |
| 5      | 8     | uint64 | session: a number that grows with every start of the sender                         |
| 13     | 4     | uint32 | sequence: number of the message in the session                                      |
| 17     | 4     | uint32 | CRC-32 (zlib's) of the 17 bytes before it and of the message                        |

The messages themselves stay as their standards have them. Time stamps alone cannot order them: a clock is set back, a
restarted agent begins to count anew, and two agents may have one id. The CRC also covers formats that have none (CPM).
It finds corruption, not forgery.
"""

from __future__ import annotations

import secrets
import struct
import time
import zlib
from dataclasses import dataclass

from cobevglue.messages import MessageError

__all__ = ["MAX_SEQUENCE", "SessionHeader", "UnknownVersionError", "decode_header", "encode_header", "new_session"]

MAX_SEQUENCE = 2**32 - 1
"""Last message of a session: at 10 Hz, after 13 years."""

_MAGIC, _VERSION = b"CBVS", 1
_FIELDS = struct.Struct("<4sBQI")
_CHECKSUM = struct.Struct("<I")
_RANDOM_BITS = 16


class UnknownVersionError(MessageError):
    """A message or a header of a version that is newer than this program."""


@dataclass(frozen=True, slots=True)
class SessionHeader:
    """Where a message belongs.

    Attributes:
        session: of the sender, 1 to 2^64 - 1; the later start has the larger number.
        sequence: of the message, 0 to 2^32 - 1.
    """

    session: int
    sequence: int


def new_session() -> int:
    """A number for a run that starts now: milliseconds since 1970, and 16 random bits for starts at one time."""
    return (time.time_ns() // 1_000_000) << _RANDOM_BITS | secrets.randbits(_RANDOM_BITS)


def encode_header(header: SessionHeader, message: bytes) -> bytes:
    """The bytes of the header of this message."""
    fields = _FIELDS.pack(_MAGIC, _VERSION, header.session, header.sequence)
    return fields + _CHECKSUM.pack(zlib.crc32(message, zlib.crc32(fields)))


def decode_header(data: bytes, message: bytes) -> SessionHeader:
    """The header in these bytes, which came with this message.

    Raises:
        UnknownVersionError: a newer version.
        MessageError: these are not the undamaged bytes of the header of this message.
    """
    if len(data) > len(_MAGIC) and data[: len(_MAGIC)] == _MAGIC and data[len(_MAGIC)] > _VERSION:
        raise UnknownVersionError(f"session header of version {data[len(_MAGIC)]}, only version {_VERSION} can be read")
    if len(data) != _FIELDS.size + _CHECKSUM.size:
        raise MessageError(f"session header: {len(data)} bytes, it has {_FIELDS.size + _CHECKSUM.size}")
    magic, version, session, sequence = _FIELDS.unpack_from(data)
    checksum = zlib.crc32(message, zlib.crc32(data[: _FIELDS.size]))
    if (
        (magic, version) != (_MAGIC, _VERSION)
        or session == 0
        or _CHECKSUM.unpack_from(data, _FIELDS.size)[0] != checksum
    ):
        raise MessageError("session header: corrupted, or of another message")
    return SessionHeader(session, sequence)
