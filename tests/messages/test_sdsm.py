"""SAE's SDSM: bytes against a second encoder and by hand, round trips to the units of the standard, damage, angles."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cobevglue import Boxes
from cobevglue.messages import MessageError, ObjectMessage
from cobevglue.se2 import SE2, wrap_angle

pytest.importorskip("asn1tools")

from cobevglue.messages.asn1_codec import SDSM
from cobevglue.messages.sdsm import MAX_OBJECTS, OWN_VEHICLE, SensorDataSharing, decode, encode

from .sample_boxes import boxes
from .second_encoder import compiled

BODY = Boxes([(0.4, 0.0, -1.0)], [(4.5, 1.9, 1.6)], [0.0])


def message(**changes: Any) -> SensorDataSharing:
    return SensorDataSharing(**{"station_id": 7, "time": 12.5, "boxes": boxes(), **changes})


@st.composite
def messages(draw: st.DrawFn) -> SensorDataSharing:
    n = draw(st.integers(1, 5))

    def column(*shape: st.SearchStrategy[float]) -> Any:
        rows = draw(st.lists(st.tuples(*shape), min_size=n, max_size=n))
        return np.array(rows, dtype=float).reshape(n, len(shape))

    labels = st.lists(st.sampled_from(["vehicle", "pedestrian", "animal", "unknown"]), min_size=n, max_size=n)
    place = draw(st.booleans())
    return SensorDataSharing(
        station_id=draw(st.integers(0, 2**32 - 1)),
        time=draw(st.floats(0, 4e9)),
        boxes=Boxes(
            center=column(*[st.floats(-2300, 2300)] * 2, st.floats(-50, 50)),
            size=column(*[st.floats(0.1, 10.2)] * 2, st.just(0.0) | st.floats(0.1, 6.3)),
            yaw=column(st.floats(-math.pi, math.pi))[:, 0],
            score=column(st.floats(0, 1))[:, 0] if draw(st.booleans()) else None,
            track_id=draw(st.lists(st.integers(0, OWN_VEHICLE - 1), min_size=n, max_size=n, unique=True)),
            label=draw(labels) if draw(st.booleans()) else None,
        ),
        body=draw(st.none() | st.just(BODY)),
        heading=draw(st.floats(-math.pi, math.pi)) if place else None,
        latitude=draw(st.floats(-90, 90)) if place else None,
        longitude=draw(st.floats(-180, 180)) if place else None,
        altitude=draw(st.none() | st.floats(-400, 6000)),
        is_infrastructure=draw(st.booleans()),
        message_count=draw(st.integers(0, 127)),
        measurement_offset=column(st.floats(-1.5, 1.5))[:, 0] if draw(st.booleans()) else None,
    )


@given(messages(), st.lists(st.floats(0, 160) | st.just(math.nan), min_size=5, max_size=5))
@settings(max_examples=150, deadline=None)
def test_round_trip_is_exact_to_the_units(sent: SensorDataSharing, speeds: list[float]) -> None:
    """Velocities along yaw: an SDSM holds no others."""
    yaw = sent.boxes.yaw
    speed = np.array(speeds[: len(sent.boxes)])
    got = decode(
        encode(dataclasses.replace(sent, velocity=np.column_stack([np.cos(yaw), np.sin(yaw)]) * speed[:, None]))
    )
    assert (got.station_id, got.is_infrastructure, got.omitted) == (sent.station_id, sent.is_infrastructure, 0)
    assert got.message_count == sent.message_count
    assert got.time == pytest.approx(sent.time, abs=0.000501)
    assert got.heading == (None if sent.heading is None else 0.0)
    for name, unit in (("latitude", 1e-7), ("longitude", 2e-7), ("altitude", 0.1)):
        if getattr(sent, name) is None:
            assert getattr(got, name) is None
        else:
            assert getattr(got, name) == pytest.approx(getattr(sent, name), rel=0, abs=0.502 * unit)
    expected = sent.boxes.transform(SE2(0.0, 0.0, sent.heading or 0.0))
    assert np.abs(got.boxes.center - expected.center).max() <= 0.0501
    assert np.abs(got.boxes.size - expected.size).max() <= 0.0501
    assert np.abs(wrap_angle(got.boxes.yaw - expected.yaw)).max() <= math.radians(0.00626)
    np.testing.assert_array_equal(got.boxes.track_id, sent.boxes.track_id)
    if sent.boxes.score is None or got.boxes.score is None:
        assert sent.boxes.score is None
        assert got.body is not None or got.boxes.score is None
    else:
        np.testing.assert_allclose(got.boxes.score, sent.boxes.score, atol=0.00501)
    if got.velocity is None:
        assert np.isnan(speed).all()
    else:
        np.testing.assert_allclose(np.hypot(*got.velocity.T), speed, atol=0.01001)
    if sent.measurement_offset is not None and got.measurement_offset is not None:
        np.testing.assert_allclose(got.measurement_offset, sent.measurement_offset, atol=0.000501)
    assert (got.body is None) == (sent.body is None)


@given(messages())
@settings(max_examples=100, deadline=None)
def test_decoded_message_encodes_to_same_bytes(sent: SensorDataSharing) -> None:
    data = encode(sent)
    assert encode(decode(data)) == data


def test_bits_of_a_message_by_hand() -> None:
    box = Boxes([(10.0, -2.0, 0.5)], [(4.5, 2.0, 1.5)], [0.0], track_id=[7])
    bits = [
        "0" + f"{5:07b}{7:032b}" + "0" + "10",  # no refPosElConf, msgCnt, sourceID, obu of an extensible type
        "1" * 7 + f"{1970:012b}{1:04b}{1:05b}{0:05b}{0:06b}{12500:016b}{840:011b}",  # all of DDateTime
        "0" + "00",  # Position3D: not extended, no elevation, no regional
        f"{1800000001:031b}{3600000000:032b}",  # latitude and longitude unavailable, above their lower bounds
        f"{255:08b}{255:08b}{65535:016b}",
        f"{0:08b}" + "1",  # one object with optional data
        "0" + "0" * 7,  # common data: not extended, none of the seven options
        "000" + f"{101:07b}{7:016b}{1500:012b}{0:06b}",  # unknown; its confidence, id, time, confidence
        "1" + f"{32767 + 100:016b}{32767 - 20:016b}{32767 + 5:016b}",  # position in 0.1 m, with z
        f"{0:04b}{0:04b}{8191:013b}{0:03b}{7200:015b}{0:03b}",  # speed unavailable, 90 degrees from north
        "00",  # detVeh
        "0" + "0000011000" + f"{200:010b}{450:012b}{30:07b}",  # size and height
    ]
    whole = "".join(bits)
    whole += "0" * (-len(whole) % 8)
    value = int(whole, 2).to_bytes(len(whole) // 8, "big")
    assert encode(message(boxes=box, message_count=5)) == bytes([0, 41, len(value)]) + value


@pytest.fixture(scope="module")
def pycrate(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Pycrate's codecs of the same types."""
    return compiled(SDSM.path.read_text(encoding="utf-8"), tmp_path_factory.mktemp("pycrate")).SDSM


@pytest.mark.parametrize("seed", range(10))
def test_same_bytes_as_a_second_encoder(pycrate: Any, seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 40))
    data = encode(
        SensorDataSharing(
            int(rng.integers(2**32)),
            float(rng.uniform(0, 4e9)),
            Boxes(
                rng.uniform(-100, 100, (n, 3)),
                rng.uniform(0.1, 30, (n, 3)),
                rng.uniform(-3, 3, n),
                rng.uniform(0, 1, n),
                rng.permutation(65535)[:n],
                rng.choice(["car", "pedestrian", "animal", "tree"], n),
            ),
            BODY if seed % 2 else None,
            heading=float(rng.uniform(-3, 3)),
            latitude=float(rng.uniform(-90, 90)),
            longitude=float(rng.uniform(-180, 180)),
            altitude=float(rng.uniform(-400, 6000)),
            velocity=rng.normal(0, 10, (n, 2)),
            measurement_offset=rng.uniform(-0.3, 0, n),
        )
    )
    frame = SDSM.decode("MessageFrame", data)
    value = SDSM.decode("SensorDataSharingMessage", frame["value"])
    codec = pycrate.SensorDataSharingMessage
    codec.set_val(value)
    assert codec.to_uper() == frame["value"]
    pycrate.MessageFrame.set_val(frame)
    assert pycrate.MessageFrame.to_uper() == data


def test_fields_we_do_not_send_agree_too(pycrate: Any) -> None:
    """Other senders may send them, and what follows them would be read wrong."""
    value = _value(encode(message(boxes=boxes(3))))
    value["refPosElConf"] = 3
    first, second, third = value["objects"]
    first["detObjCommon"] |= {
        "speedZ": 5,
        "speedConfidenceZ": 1,
        "accel4way": {"long": -2000, "lat": 2001, "vert": -127, "yaw": 32767},
        "accCfdX": 1,
        "accCfdY": 2,
        "accCfdZ": 3,
        "accCfdYaw": 7,
    }
    first["detObjOptData"][1].update(
        vehAttitude={"pitch": -7200, "roll": 14400, "yaw": 1},
        vehAttitudeConfidence={"pitchConfidence": 1, "rollConfidence": 2, "yawConfidence": 3},
        vehAngVel={"pitchRate": -1, "rollRate": 1},
        vehAngVelConfidence={"rollRateConfidence": 4},
        vehicleSizeConfidence={"vehicleWidthConfidence": 13, "vehicleLengthConfidence": 0},
        vehicleClass=11,
        classConf=75,
    )
    second["detObjOptData"] = (
        "detVRU",
        {"basicType": "aPEDESTRIAN", "propulsion": ("human", "onFoot"), "attachment": "pet", "radius": 200},
    )
    del third["detObjOptData"]
    data = SDSM.encode("SensorDataSharingMessage", value)
    pycrate.SensorDataSharingMessage.set_val(value)
    assert pycrate.SensorDataSharingMessage.to_uper() == data
    got = decode(_bytes(value))
    assert (len(got.boxes), got.omitted) == (1, 2), "a road user without size and an object without data are no boxes"


@pytest.mark.parametrize(
    ("heading", "center", "yaw", "east_north", "from_north"),
    [
        (0.0, (10.0, 2.0), 0.0, (100, 20), 90.0),  # facing east
        (90.0, (10.0, 2.0), 0.0, (-20, 100), 0.0),  # facing north: ahead is north, to the left is west
        (180.0, (10.0, 2.0), 90.0, (-100, -20), 180.0),  # facing west, the object faces left: south
    ],
)
def test_angles_and_axes_of_the_standard(
    heading: float, center: Any, yaw: float, east_north: Any, from_north: float
) -> None:
    box = boxes(1, center=[(*center, 0.5)], yaw=[math.radians(yaw)])
    (item,) = _value(encode(message(boxes=box, heading=math.radians(heading))))["objects"]
    common = item["detObjCommon"]
    assert (common["pos"]["offsetX"], common["pos"]["offsetY"], common["pos"]["offsetZ"]) == (*east_north, 5)
    assert common["heading"] == 80 * from_north
    assert item["detObjOptData"] == ("detVeh", {"size": {"width": 200, "length": 450}, "height": 30})


def test_object_that_moves_backwards_is_turned() -> None:
    got = decode(encode(message(boxes=boxes(1, yaw=[0.0]), velocity=[(-3.0, 1.0)])))
    assert got.velocity is not None
    np.testing.assert_allclose(got.velocity, [(-3.0, 0.0)], atol=1e-9)
    assert abs(got.boxes.yaw[0]) == pytest.approx(math.pi)


def test_large_and_small_objects_saturate() -> None:
    sizes = [(50.0, 20.0, 9.0), (0.001, 0.001, 0.001)]
    got = decode(encode(message(boxes=boxes(2, size=sizes)))).boxes
    np.testing.assert_allclose(got.size, [(40.95, 10.23, 6.35), (0.01, 0.01, 0.05)])


def test_labels_become_the_kinds_of_objects() -> None:
    sent = ["Car", "bicycle", "animal", "unicorn"]
    got = decode(encode(message(boxes=boxes(4, label=sent)))).boxes
    assert got.label is not None
    assert got.label.tolist() == ["vehicle", "pedestrian", "animal", "unknown"]


@pytest.mark.parametrize("time", [0.0, 951_782_399.999, 1_700_000_000.5, 67_090_000_000.0])
def test_times_survive_as_dates(time: float) -> None:
    assert decode(encode(message(time=time))).time == pytest.approx(time, abs=1e-4)


def test_time_zone_of_others_is_heeded() -> None:
    value = _value(encode(message(time=100_000.0)))
    value["sDSMTimeStamp"]["offset"] = 60
    assert decode(_bytes(value)).time == 100_000.0 - 3600.0


def test_largest_message_survives() -> None:
    assert len(decode(encode(message(boxes=boxes(MAX_OBJECTS)))).boxes) == MAX_OBJECTS


def test_object_message_and_back() -> None:
    sent = ObjectMessage("42", 1.5, 15, boxes(), BODY)
    got = decode(encode(SensorDataSharing.from_message(sent))).object_message(frame=15)
    assert (got.agent_id, got.time, got.frame) == ("42", 1.5, 15)
    np.testing.assert_allclose(got.boxes.bev, sent.boxes.bev, atol=0.051)
    assert got.body is not None
    with pytest.raises(MessageError, match=r"agent_id must be a station id, .* got 'car1'"):
        SensorDataSharing.from_message(ObjectMessage("car1", 1.5, 15, boxes()))


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"station_id": -1}, "station_id must be from 0 to 4294967295, got -1"),
        ({"time": -1.0}, "time must be from 0.0"),
        ({"message_count": 128}, "message_count must be from 0 to 127"),
        ({"altitude": 9000}, "altitude must be from -409.5"),
        ({"latitude": 48.0}, "latitude and longitude must be given both"),
        ({"latitude": 48.0, "longitude": 11.0}, "heading: it must be known with a latitude"),
        ({"boxes": None}, "boxes must be Boxes"),
        ({"body": boxes(2)}, "body must be Boxes with one row"),
        ({"boxes": boxes(MAX_OBJECTS), "body": BODY}, "boxes: 256 objects, an SDSM holds at most 256 with"),
        ({"velocity": [1, 2]}, r"velocity must have shape \(2, 2\), got \(2,\)"),
        ({"boxes": boxes(0)}, "boxes: an SDSM holds at least one object"),
        ({"boxes": boxes(track_id=None)}, "boxes must have a track_id"),
        ({"boxes": boxes(track_id=[3, 3 + OWN_VEHICLE])}, "two ids are the same modulo 65535"),
        ({"boxes": boxes(center=[(0, 0, 0), (0, 3300, 0)])}, r"center \(east, north, up\): row 1 .* at most 3276.7"),
        ({"boxes": boxes(score=[0.5, 1.5])}, "score: row 1 is 1.5, an SDSM holds scores from 0 to 1"),
        ({"velocity": [(0, 0), (300, 0)]}, "velocity along yaw: row 1 .* at most 163.8"),
        ({"measurement_offset": [0, 5]}, "measurement_offset: row 1 is 5.0, an SDSM holds at most 1.5"),
        ({"body": BODY.replace(center=[(9, 0, 0)])}, "body must be located at the origin"),
    ],
)
def test_values_beyond_limits_are_refused(changes: dict[str, Any], expected: str) -> None:
    with pytest.raises(MessageError, match=expected):
        encode(message(**changes))


def test_any_truncation_or_tail_is_an_error() -> None:
    data = encode(message(body=BODY))
    for length in range(len(data)):
        with pytest.raises(MessageError):
            decode(data[:length])
    with pytest.raises(MessageError, match="oversized"):
        decode(data + b"\0")
    value = SDSM.decode("MessageFrame", data)["value"]
    with pytest.raises(MessageError, match="oversized"):
        decode(SDSM.encode("MessageFrame", {"messageId": 41, "value": value + b"\0"}))


@given(st.binary(max_size=200) | st.binary(max_size=200).map(lambda tail: bytes([0, 41]) + tail))
@settings(max_examples=200, deadline=None)
def test_any_bytes_decode_or_raise_message_error(data: bytes) -> None:
    _decodes_or_is_refused(data)


@given(messages(), st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255)), min_size=1, max_size=4))
@settings(max_examples=150, deadline=None)
def test_damaged_messages_decode_or_raise_message_error(
    sent: SensorDataSharing, changes: list[tuple[int, int]]
) -> None:
    data = bytearray(encode(sent))
    for position, value in changes:
        data[position % len(data)] = value
    _decodes_or_is_refused(bytes(data))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda v: v["sDSMTimeStamp"].pop("day"), "sDSMTimeStamp is not a complete date and time"),
        (lambda v: v["sDSMTimeStamp"].update(month=0), "sDSMTimeStamp is not a complete date and time"),
        (lambda v: v["sDSMTimeStamp"].update(second=65535), "sDSMTimeStamp is not a date and time since 1970"),
        (lambda v: v["refPos"].update(regional=[{"regionId": 1, "value": b"a"}]), "refPos has a regional extension"),
        (lambda v: v["objects"].append(v["objects"][0]), "invalid boxes: track_id: rows 0 and 2 have the same id 7"),
    ],
)
def test_message_that_cannot_be_used_is_named(change: Callable[[Any], None], expected: str) -> None:
    value = _value(encode(message()))
    change(value)
    with pytest.raises(MessageError, match=expected):
        decode(_bytes(value))


def test_number_beyond_its_limit_is_refused() -> None:
    """16 bits also hold 32768, which no offset is; 15 bits hold headings above a whole turn."""
    data = encode(message(boxes=boxes(1, center=[(3276.7, 0.0, 0.0)])))
    value = int.from_bytes(data, "big")
    shift = next(s for s in range(8 * len(data)) if (value >> s) & 0xFFFF == 65534 and (value >> s + 16) & 1)
    with pytest.raises(MessageError, match="offsetX"):
        decode((value + (1 << shift)).to_bytes(len(data), "big"))


def test_message_of_another_kind_is_refused() -> None:
    with pytest.raises(MessageError, match="not an SDSM: it has messageId 20, not 41"):
        decode(SDSM.encode("MessageFrame", {"messageId": 20, "value": b"\0"}))
    with pytest.raises(MessageError, match="a message is bytes"):
        decode("text")  # type: ignore[arg-type]


def _value(data: bytes) -> Any:
    return SDSM.decode("SensorDataSharingMessage", SDSM.decode("MessageFrame", data)["value"])


def _bytes(value: Any) -> bytes:
    data = SDSM.encode("SensorDataSharingMessage", value)
    return SDSM.encode("MessageFrame", {"messageId": 41, "value": data})


def _decodes_or_is_refused(data: bytes) -> None:
    try:
        got = decode(data)
    except MessageError:
        return
    assert np.isfinite(got.boxes.bev).all()
    assert (got.boxes.size[:, :2] > 0).all()
