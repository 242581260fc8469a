"""The object message: byte-exact, and damage of any kind is found."""

from __future__ import annotations

import math
import struct
import zlib
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cobevglue.boxes import Boxes
from cobevglue.messages import (
    MAX_AGENT_ID_BYTES,
    MAX_OBJECTS,
    MAX_TRACK_ID,
    MessageError,
    ObjectMessage,
    decode,
    encode,
    encoded_size,
)

from .sample_boxes import boxes


def message(**changes: Any) -> ObjectMessage:
    fields: dict[str, Any] = {"agent_id": "car1", "time": 1.5, "frame": 15, "boxes": boxes()}
    return ObjectMessage(**{**fields, **changes})


def resealed(data: bytes) -> bytes:
    """These bytes with the checksum made right again: what a faulty sender would send."""
    return data[:-4] + struct.pack("<I", zlib.crc32(data[:-4]))


def with_objects(rows: list[list[float]], origin: tuple[float, float] = (0.0, 0.0)) -> bytes:
    """A well-formed message around any eight numbers an object, valid or not."""
    body = struct.pack("<4sBBHId2d", b"CBVG", 2, 1, len(rows), 0, 0.0, *origin) + b"a"
    return resealed(body + b"".join(struct.pack("<8f", *row) for row in rows) + b"\0" * 4)


GOOD_ROW = [1.0, 2.0, 0.0, 4.5, 2.0, 1.5, 0.1, 3.0]

float32 = st.floats(-500.0, 500.0, width=32).map(lambda value: value + 0.0)  # no negative zeros
side = st.floats(0.125, 100.0, width=32)
yaw32 = st.floats(float(-np.float32(np.pi)), float(np.float32(np.pi)), width=32)
agent_ids = st.text(st.characters(exclude_categories=["C", "Z"]), min_size=1, max_size=16)


@st.composite
def messages(draw: st.DrawFn) -> ObjectMessage:
    """Messages whose numbers float32 holds exactly."""
    n = draw(st.integers(0, 6))
    rows = draw(st.lists(st.tuples(*[float32] * 3, *[side] * 3, yaw32), min_size=n, max_size=n))
    table = np.array(rows).reshape(n, 7)
    ids = draw(st.none() | st.lists(st.integers(0, MAX_TRACK_ID), min_size=n, max_size=n, unique=True))
    return ObjectMessage(
        agent_id=draw(agent_ids),
        time=draw(st.floats(allow_nan=False, allow_infinity=False)),
        frame=draw(st.integers(0, 2**32 - 1)),
        boxes=Boxes(table[:, :3], table[:, 3:6], table[:, 6], track_id=ids),
    )


def test_layout_matches_documentation_byte_for_byte() -> None:
    data = encode(message(agent_id="é", boxes=boxes(1, center=[[1, 2, 3]], yaw=[0.5])))
    body = (
        b"CBVG"
        + bytes([2, 2])
        + (1).to_bytes(2, "little")
        + (15).to_bytes(4, "little")
        + struct.pack("<3d", 1.5, 0.0, 0.0)
    )
    body += b"\xc3\xa9" + struct.pack("<8f", 1, 2, 3, 4.5, 2.0, 1.5, 0.5, 7)
    assert data == body + struct.pack("<I", zlib.crc32(body))


def test_bytes_of_version_1_stay_readable() -> None:
    frozen = bytes.fromhex(
        "43425647 01 01 0100 02000000 0000000000001040 61"
        "00000000 000080bf 0000003f 00008040 00000040 0000c03f 000080bf 00002041 61578226"
    )
    old = decode(frozen)
    assert (old.agent_id, old.time, old.frame) == ("a", 4.0, 2)
    np.testing.assert_array_equal(old.boxes.bev, [[0.0, -1.0, 4.0, 2.0, -1.0]])
    assert old.boxes.track_id is not None
    assert old.boxes.track_id.tolist() == [10]


def test_world_positions_are_sent_relative_to_origin() -> None:
    sent = boxes(3, center=[[691_000.123, 5_334_000.75, 512.4], [691_050.0, 5_334_100.001, 0], [690_990, 5_333_900, 0]])
    data = encode(message(boxes=sent))
    origin = struct.unpack_from("<2d", data, 20)
    assert origin == (675 * 1024, 5209 * 1024), "the median, to the nearest kilometre of 1024 m"
    x, y, z = struct.unpack_from("<3f", data, 36 + len("car1"))
    np.testing.assert_allclose((origin[0] + x, origin[1] + y, z), (691_000.123, 5_334_000.75, 512.4), atol=1e-4)
    np.testing.assert_allclose(decode(data).boxes.center, sent.center, rtol=0, atol=1e-4)


@given(
    st.tuples(st.floats(-1e7, 1e7), st.floats(-1e7, 1e7), st.floats(-9000, 9000)),
    st.lists(st.tuples(*[st.floats(-500, 500)] * 3), min_size=1, max_size=6),
)
def test_positions_in_any_frame_survive_within_a_millimetre(
    origin: tuple[float, float, float], offsets: list[tuple[float, float, float]]
) -> None:
    center = np.array(origin) + np.array(offsets)
    got = decode(encode(message(boxes=boxes(len(center), center=center))))
    assert np.abs(got.boxes.center - center).max() <= 1e-3


@given(messages())
def test_float32_values_round_trip_exactly(sent: ObjectMessage) -> None:
    data = encode(sent)
    got = decode(data)
    assert (got.agent_id, got.time, got.frame) == (sent.agent_id, sent.time, sent.frame)
    np.testing.assert_array_equal(got.boxes.center, sent.boxes.center)
    np.testing.assert_array_equal(got.boxes.size, sent.boxes.size)
    np.testing.assert_array_equal(got.boxes.yaw, sent.boxes.yaw)
    if sent.boxes.track_id is None or len(sent.boxes) == 0:
        assert got.boxes.track_id is None
    else:
        np.testing.assert_array_equal(got.boxes.track_id, sent.boxes.track_id)
    assert encode(got) == data
    assert len(data) == encoded_size(len(sent.boxes), sent.agent_id)


def test_scores_and_labels_stay_behind() -> None:
    got = decode(encode(message(boxes=boxes(2, score=[0.5, 0.6], label=["car", "van"]))))
    assert got.boxes.score is None
    assert got.boxes.label is None


def test_boxes_without_track_ids_come_back_without_them() -> None:
    assert decode(encode(message(boxes=boxes(track_id=None)))).boxes.track_id is None


@pytest.mark.parametrize("track_id", [0, 1, 2**24 - 1, 2**24])
def test_track_ids_up_to_2_24_are_exact(track_id: int) -> None:
    got = decode(encode(message(boxes=boxes(1, track_id=[track_id])))).boxes
    assert got.track_id is not None
    assert got.track_id.tolist() == [track_id]


@pytest.mark.parametrize(
    ("yaw", "expected", "why"),
    [
        (0.0, 0.0, "an angle within half a turn is sent as it is"),
        (math.pi, math.pi, "pi stays pi, although float32 rounds it up a little"),
        (-math.pi, -math.pi, "and so does -pi"),
        (2 * math.pi + 0.5, 0.5, "one turn too many is taken off"),
        (2000 * math.pi + 0.5, 0.5, "so are a thousand, before rounding could cost 0.0005 rad"),
        (-3.5, 2 * math.pi - 3.5, "the same below"),
    ],
)
def test_yaw_is_sent_within_half_a_turn(yaw: float, expected: float, why: str) -> None:
    data = encode(message(boxes=boxes(1, yaw=[yaw])))
    assert decode(data).boxes.yaw[0] == pytest.approx(expected, abs=3e-7), why
    assert encode(decode(data)) == data, "and encoding it again changes nothing"


@pytest.mark.parametrize(
    ("n", "agent_id", "size"),
    [
        (0, "a", 41),
        (1, "a", 73),
        (20, "car1", 684),
        (MAX_OBJECTS, "a" * MAX_AGENT_ID_BYTES, 131_176),
    ],
)
def test_size_is_header_id_objects_checksum(n: int, agent_id: str, size: int) -> None:
    assert encoded_size(n, agent_id) == size
    assert len(encode(message(agent_id=agent_id, boxes=boxes(n)))) == size


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"agent_id": ""}, "agent_id must have 1 to 64 bytes"),
        ({"agent_id": "é" * 33}, "agent_id must have 1 to 64 bytes in UTF-8, got 66"),
        ({"agent_id": "a\nb"}, "agent_id must be printable"),
        ({"agent_id": "\ud800"}, "agent_id must be printable"),
        ({"agent_id": 7}, "agent_id must be a string, got 7"),
        ({"time": math.nan}, "time must be a finite"),
        ({"time": math.inf}, "time must be a finite"),
        ({"time": "now"}, "time must be a finite"),
        ({"frame": -1}, "frame must be from 0"),
        ({"frame": 2**32}, "frame must be from 0"),
        ({"frame": 1.0}, "frame must be a whole number"),
        ({"frame": True}, "frame must be a whole number"),
        ({"boxes": None}, "boxes must be Boxes, got NoneType"),
        ({"boxes": boxes(MAX_OBJECTS + 1)}, "boxes: 4097 objects, a message holds at most 4096"),
    ],
)
def test_message_outside_limits_raises(changes: dict[str, Any], expected: str) -> None:
    with pytest.raises(MessageError, match=expected):
        message(**changes)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"track_id": [5, 2**24 + 1]}, "track_id: row 1 is 16777217"),
        ({"track_id": [-3, 5]}, "track_id: row 0 is -3"),
        ({"center": [[0, 0, 0], [0, 1e39, 0]]}, "boxes do not fit float32: center: row 1"),
        (
            {"center": [[0, 0, 0], [60_000.0018, 0, 0]]},
            r"center: row 1 is \[60000.0018, 0.0, 0.0\], too far from the other",
        ),
        ({"center": [[0, 0, 60_000.0018], [0, 0, 0]]}, "center: row 0 is .* its rounding error would be 0.0018 m"),
        ({"size": [[4, 1e-60, 1], [4, 2, 1]]}, "boxes do not fit float32: size: row 0"),
    ],
)
def test_boxes_that_would_arrive_wrong_are_not_encoded(changes: dict[str, Any], expected: str) -> None:
    with pytest.raises(MessageError, match=expected):
        encode(message(boxes=boxes(**changes)))


@pytest.mark.parametrize("n", [-1, MAX_OBJECTS + 1])
def test_size_of_impossible_message_raises(n: int) -> None:
    with pytest.raises(MessageError, match="n_objects"):
        encoded_size(n, "a")


def test_any_truncation_is_an_error() -> None:
    data = encode(message())
    for length in range(len(data)):
        with pytest.raises(MessageError, match="truncated"):
            decode(data[:length])


@given(messages(), st.data())
@settings(max_examples=50)
def test_any_truncation_of_any_message_is_an_error(sent: ObjectMessage, data: st.DataObject) -> None:
    whole = encode(sent)
    with pytest.raises(MessageError):
        decode(whole[: data.draw(st.integers(0, len(whole) - 1))])


def test_any_single_flipped_bit_is_an_error() -> None:
    data = encode(message())
    for bit in range(8 * len(data)):
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << (bit % 8)
        with pytest.raises(MessageError):
            decode(damaged)


@given(messages(), st.binary(min_size=1, max_size=40))
def test_anything_behind_the_message_is_an_error(sent: ObjectMessage, tail: bytes) -> None:
    with pytest.raises(MessageError, match="oversized"):
        decode(encode(sent) + tail)


@given(st.binary(max_size=200) | st.binary(max_size=200).map(lambda tail: b"CBVG\x02" + tail))
def test_any_bytes_decode_or_raise_message_error(data: bytes) -> None:
    try:
        got = decode(data)
    except MessageError:
        return
    assert got.agent_id.isprintable()


@given(
    st.integers(0, 3),
    st.lists(st.lists(st.floats(width=32), min_size=8, max_size=8), max_size=3),
    st.lists(st.tuples(st.integers(0, 60), st.integers(0, 255)), max_size=4),
)
@settings(max_examples=300)
def test_checksummed_garbage_decodes_or_raises_message_error(
    good: int, rows: list[list[float]], changes: list[tuple[int, int]]
) -> None:
    data = bytearray(with_objects([[*GOOD_ROW[:7], float(i)] for i in range(good)] + rows))
    for position, value in changes:
        data[position % len(data)] = value
    try:
        got = decode(resealed(bytes(data)))
    except MessageError:
        return
    assert np.isfinite(got.boxes.bev).all()
    assert (got.boxes.size[:, :2] > 0).all()


@pytest.mark.parametrize(
    ("column", "value", "expected"),
    [
        (0, math.nan, "center: row 1 is not finite"),
        (2, math.inf, "center: row 1 is not finite"),
        (3, -1.0, "size: row 1"),
        (4, 0.0, "size: row 1"),
        (5, -0.5, "size: row 1"),
        (6, math.nan, "yaw: row 1 is not finite"),
        (7, math.nan, "track_id: row 1 is nan"),
        (7, 1.5, "track_id: row 1 is 1.5"),
        (7, -1.0, "track_id: row 1 is -1.0"),
        (7, -3.0, "track_id: row 1 is -3.0"),
        (7, 2.0**25, "track_id: row 1 is 33554432.0"),
        (7, 3.0, "track_id: rows 0 and 1 have the same id 3"),
    ],
)
def test_invalid_checksummed_boxes_are_named_by_row(column: int, value: float, expected: str) -> None:
    row = [*GOOD_ROW[:7], 4.0]
    row[column] = value
    with pytest.raises(MessageError, match=f"invalid boxes: {expected}"):
        decode(with_objects([GOOD_ROW, row]))


def test_a_signalling_nan_is_refused_like_any_other() -> None:
    data = bytearray(with_objects([GOOD_ROW]))
    data[37:41] = bytes.fromhex("0100807f")
    with pytest.raises(MessageError, match="invalid boxes: center: row 0 is not finite"):
        decode(resealed(bytes(data)))


@pytest.mark.parametrize(
    ("offset", "patch", "expected"),
    [
        (0, b"OPUS", "not an object message: it starts with b'OPUS'"),
        (4, b"\x03", "unknown version 3"),
        (4, b"\x00", "unknown version 0"),
        (5, b"\x00", "corrupted: the header has an agent id of 0 bytes"),
        (5, b"\x41", "corrupted: the header has an agent id of 65 bytes"),
        (6, b"\xff\xff", "65535 objects"),
        (12, struct.pack("<d", math.nan), "time must be a finite"),
        (20, struct.pack("<d", math.inf), "origin must be finite"),
        (36, b"\xff", "agent_id is not UTF-8"),
        (36, b"\n", "agent_id must be printable"),
    ],
)
def test_wrong_header_is_refused_despite_checksum(offset: int, patch: bytes, expected: str) -> None:
    data = bytearray(encode(message()))
    data[offset : offset + len(patch)] = patch
    with pytest.raises(MessageError, match=expected):
        decode(resealed(bytes(data)))


@pytest.mark.parametrize("data", ["CBVG", None, 5, [1, 2]])
def test_non_bytes_raise_a_message_error(data: Any) -> None:
    with pytest.raises(MessageError, match="a message is bytes"):
        decode(data)


@pytest.mark.parametrize("kind", [bytes, bytearray, memoryview])
def test_any_kind_of_bytes_can_be_decoded(kind: Any) -> None:
    assert decode(kind(encode(message()))).agent_id == "car1"


def test_a_message_error_is_a_value_error() -> None:
    assert issubclass(MessageError, ValueError)


@pytest.mark.parametrize("ids", [True, False])
@pytest.mark.parametrize("n", [0, 2])
def test_own_vehicle_is_the_last_object(n: int, ids: bool) -> None:
    objects = boxes(n) if ids else boxes(n, track_id=None)
    body = Boxes([(0.5, 0.0, -0.75)], [(4.5, 2.0, 1.5)], [0.25])
    data = encode(message(boxes=objects, body=body))
    assert len(data) == encoded_size(n + 1, "car1")
    assert struct.unpack("<8f", data[-36:-4]) == (0.5, 0.0, -0.75, 4.5, 2.0, 1.5, 0.25, -2.0)
    decoded = decode(data)
    assert decoded.body is not None
    np.testing.assert_array_equal(decoded.body.bev, body.bev)
    assert decoded.body.track_id is None
    np.testing.assert_array_equal(decoded.boxes.bev, objects.bev)
    assert decode(encode(message(boxes=objects))).body is None


@pytest.mark.parametrize(
    ("rows", "error"),
    [
        ([[*GOOD_ROW[:7], -2.0], GOOD_ROW], "track_id: row 0 is -2.0"),  # only the last object may be the own vehicle
        ([GOOD_ROW, [1.0, 2.0, 0.0, -4.5, 2.0, 1.5, 0.1, -2.0]], "size"),
    ],
)
def test_invalid_own_vehicle_is_refused(rows: list[list[float]], error: str) -> None:
    with pytest.raises(MessageError, match=error):
        decode(with_objects(rows))


def test_body_needs_one_row() -> None:
    with pytest.raises(MessageError, match="body must be Boxes with one row"):
        message(body=boxes(2))
