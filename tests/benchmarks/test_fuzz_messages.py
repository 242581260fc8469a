"""The fuzzer: a few thousand damaged messages without a failure, and failures that it finds."""

from __future__ import annotations

import struct
import zlib

import pytest

from fuzz_messages import FORMATS, Report, check_header, check_object_message, fuzz, object_messages


@pytest.mark.parametrize(("name", "messages"), [("object", 2000), ("cpm", 300), ("sdsm", 300)])
def test_damaged_messages_do_no_harm(name: str, messages: int) -> None:
    report = fuzz(name, 1, messages)
    assert report.failures == []
    assert report.messages == messages
    assert report.accepted > report.unchanged, "some damage gets through, or nothing is tested"
    assert name in FORMATS


def test_accepted_bytes_must_be_known() -> None:
    data = object_messages(0)[2]
    body = bytearray(data[:-4])
    body[60] ^= 1
    forged = bytes(body) + struct.pack("<I", zlib.crc32(body))
    report = Report()
    check_object_message(forged, frozenset([data]), False, report)
    assert "no message that was sent" in report.failures[0]


def test_header_of_another_message_is_found() -> None:
    report = Report()
    check_header(b"a", b"b", report)
    assert report.failures == []
