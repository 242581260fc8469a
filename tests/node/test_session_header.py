"""The session header: which run of the sender a message is of, and whether either was damaged."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from cobevglue.messages import MessageError
from cobevglue.node.session_header import (
    SessionHeader,
    UnknownVersionError,
    decode_header,
    encode_header,
    new_session,
)

MESSAGE = b"some message"


@given(st.integers(1, 2**64 - 1), st.integers(0, 2**32 - 1), st.binary(max_size=50))
def test_round_trip(session: int, sequence: int, message: bytes) -> None:
    header = SessionHeader(session, sequence)
    assert decode_header(encode_header(header, message), message) == header


def test_layout_is_as_documented() -> None:
    data = encode_header(SessionHeader(0x0102030405060708, 0x0A0B0C0D), MESSAGE)
    assert data[:17].hex() == "43425653" + "01" + "0807060504030201" + "0d0c0b0a"
    assert len(data) == 21


def test_any_flipped_bit_is_found() -> None:
    data = encode_header(SessionHeader(5, 7), MESSAGE)
    for bit in range(8 * len(data)):
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << bit % 8
        with pytest.raises(MessageError):
            decode_header(bytes(damaged), MESSAGE)
    for bit in range(8 * len(MESSAGE)):
        message = bytearray(MESSAGE)
        message[bit // 8] ^= 1 << bit % 8
        with pytest.raises(MessageError):
            decode_header(data, bytes(message))


@given(st.binary(max_size=40))
def test_any_bytes_raise_message_error(data: bytes) -> None:
    with pytest.raises(MessageError):
        decode_header(data, MESSAGE)


def test_newer_version_is_named() -> None:
    data = bytearray(encode_header(SessionHeader(5, 7), MESSAGE))
    data[4] = 9
    with pytest.raises(UnknownVersionError, match="version 9"):
        decode_header(bytes(data) + b"more", MESSAGE)


def test_later_start_has_the_larger_session() -> None:
    first = new_session()
    assert 0 < first < 2**64
    assert new_session() >> 16 >= first >> 16
