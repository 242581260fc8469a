"""ETSI's CPM: bytes against a second encoder and by hand, round trips to the units of the standard, damage, angles."""

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
from cobevglue.se2 import wrap_angle

pytest.importorskip("asn1tools")

from cobevglue.messages.asn1_codec import CPM
from cobevglue.messages.cpm import MAX_OBJECTS, OWN_VEHICLE, CollectivePerception, decode, encode

from .sample_boxes import boxes
from .second_encoder import compiled

ARRAYS = ("velocity", "age", "measurement_offset", "position_std", "yaw_std")
BODY = Boxes([(0.4, 0.0, -1.0)], [(4.5, 1.9, 1.6)], [0.0])


def message(**changes: Any) -> CollectivePerception:
    return CollectivePerception(**{"station_id": 7, "time": 12.5, "boxes": boxes(), **changes})


@st.composite
def messages(draw: st.DrawFn) -> CollectivePerception:
    n = draw(st.integers(0, 5))

    def column(*shape: st.SearchStrategy[float]) -> Any:
        rows = draw(st.lists(st.tuples(*shape), min_size=n, max_size=n))
        return np.array(rows, dtype=float).reshape(n, len(shape))

    def optional(values: st.SearchStrategy[float]) -> Any:
        return column(values)[:, 0] if draw(st.booleans()) else None

    unknown = st.just(math.nan)
    side = st.floats(0.06, 25.3)
    labels = st.lists(st.sampled_from(["car", "truck", "pedestrian", "bus", "unknown"]), min_size=n, max_size=n)
    return CollectivePerception(
        station_id=draw(st.integers(0, 2**32 - 1)),
        time=draw(st.floats(0, 4e9)),
        boxes=Boxes(
            center=column(*[st.floats(-900, 900)] * 2, st.floats(-50, 50)),
            size=column(side, side, st.just(0.0) | side),
            yaw=column(st.floats(-math.pi, math.pi))[:, 0],
            score=optional(st.floats(0, 1)),
            track_id=draw(st.lists(st.integers(0, OWN_VEHICLE - 1), min_size=n, max_size=n, unique=True)),
            label=draw(labels) if draw(st.booleans()) else None,
        ),
        body=draw(st.none() | st.just(BODY)),
        heading=draw(st.none() | st.floats(-math.pi, math.pi)),
        latitude=draw(st.none() | st.floats(-90, 90)),
        longitude=draw(st.none() | st.floats(-180, 180)),
        altitude=draw(st.none() | st.floats(-900, 7900)),
        velocity=column(*[st.floats(-80, 80) | unknown] * 2) if draw(st.booleans()) else None,
        age=optional(st.floats(0, 1.5) | unknown),
        measurement_offset=optional(st.floats(-2, 2)),
        position_std=optional(st.floats(0.01, 15) | unknown),
        yaw_std=optional(st.floats(0.001, 0.1) | unknown),
    )


@given(messages())
@settings(max_examples=200, deadline=None)
def test_round_trip_is_exact_to_the_units(sent: CollectivePerception) -> None:
    data = encode(sent)
    got = decode(data)
    assert (got.station_id, got.is_infrastructure, got.omitted) == (sent.station_id, False, 0)
    assert got.time == pytest.approx(sent.time, abs=0.0005001)
    _close(got.heading, sent.heading, math.radians(0.05001), angle=True)
    _close(got.latitude, sent.latitude, 0.501e-7)
    _close(got.longitude, sent.longitude, 1.01e-7)
    _close(got.altitude, sent.altitude, 0.00501)
    assert len(got.boxes) == len(sent.boxes)
    gap = np.abs(got.boxes.center - sent.boxes.center)
    assert np.hypot(gap[:, 0], gap[:, 1]).max(initial=0) <= 0.0051 * math.sqrt(2)
    assert gap[:, 2].max(initial=0) <= 0.0051
    assert np.abs(got.boxes.size - sent.boxes.size).max(initial=0) <= 0.0501
    assert np.abs(wrap_angle(got.boxes.yaw - sent.boxes.yaw)).max(initial=0) <= math.radians(0.0501)
    if len(sent.boxes):
        np.testing.assert_array_equal(got.boxes.track_id, sent.boxes.track_id)
        _close(got.boxes.score, sent.boxes.score, 0.0334)
        np.testing.assert_array_equal(got.boxes.label, sent.boxes.label)
    _close_where_known(got.age, sent.age, 0.000501)
    _close_where_known(got.position_std, sent.position_std, 0.0052)
    _close_where_known(got.yaw_std, sent.yaw_std, math.radians(0.052))
    if sent.velocity is not None:
        _close_where_known(got.velocity, sent.velocity + 0 * sent.velocity[:, ::-1], 0.0051 * math.sqrt(2))
    assert (got.body is None) == (sent.body is None)
    if got.body is not None:
        np.testing.assert_allclose(got.body.bev, BODY.bev, atol=0.051)


@given(messages())
@settings(max_examples=100, deadline=None)
def test_decoded_message_encodes_to_same_bytes(sent: CollectivePerception) -> None:
    data = encode(dataclasses.replace(sent, sensor_type=None))
    assert encode(decode(data)) == data


def test_bits_of_a_message_by_hand() -> None:
    data = encode(message(boxes=boxes(0), sensor_type=None))
    container = "0" + "00000000" + "0" + "00000000"  # not extended, 0 objects in all, list not extended, 0 in it
    container += "0" * (-len(container) % 8)
    vehicle = "0" + "000" + f"{3601:012b}" + f"{126:07b}"  # no extension, no options, angle and confidence unavailable
    vehicle += "0" * (-len(vehicle) % 8)
    bits = [
        f"{2:08b}{14:08b}{7:032b}",  # protocolVersion, messageId, stationId
        "0",  # CpmPayload is not extended
        "0" + "00",  # ManagementContainer: not extended, no segmentation, no rate
        f"{12500:042b}",
        f"{1800000001:031b}{3600000001:032b}",  # latitude and longitude unavailable, above their lower bounds
        f"{4095:012b}{4095:012b}{3601:012b}",
        f"{900001:020b}{15:04b}",  # altitude
        "0" + f"{2 - 1:03b}",  # two containers
        f"{1 - 1:04b}{len(vehicle) // 8:08b}" + vehicle,
        f"{5 - 1:04b}{len(container) // 8:08b}" + container,
    ]
    whole = "".join(bits)
    whole += "0" * (-len(whole) % 8)
    assert data == int(whole, 2).to_bytes(len(whole) // 8, "big")


@pytest.fixture(scope="module")
def pycrate(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """Pycrate's codecs, of the same types with the open type and the union as the standard has them."""
    text = CPM.path.read_text(encoding="utf-8")
    for ours, standard in (
        ("containerId    CpmContainerId,", "containerId CPM-CONTAINER-ID-AND-TYPE.&id({CpmContainers}),"),
        ("containerData  OCTET STRING", "containerData CPM-CONTAINER-ID-AND-TYPE.&Type({CpmContainers}{@containerId})"),
        ("TrafficParticipantType (0..14)", "TrafficParticipantType (0 | 5..11 | 14)"),
        (
            "CpmContainerId ::=",
            """CPM-CONTAINER-ID-AND-TYPE ::= CLASS { &id CpmContainerId UNIQUE, &Type }
            WITH SYNTAX { &Type IDENTIFIED BY &id }
            CpmContainers CPM-CONTAINER-ID-AND-TYPE ::= {
                { OriginatingVehicleContainer IDENTIFIED BY 1 } | { OriginatingRsuContainer IDENTIFIED BY 2 } |
                { SensorInformationContainer IDENTIFIED BY 3 } | { PerceivedObjectContainer IDENTIFIED BY 5 }, ... }
            CpmContainerId ::=""",
        ),
    ):
        assert ours in text
        text = text.replace(ours, standard)
    return compiled(text, tmp_path_factory.mktemp("pycrate")).CPM_PDU_Descriptions


CONTAINERS = {
    1: "OriginatingVehicleContainer",
    2: "OriginatingRsuContainer",
    3: "SensorInformationContainer",
    5: "PerceivedObjectContainer",
}


@pytest.mark.parametrize("seed", range(20))
def test_same_bytes_as_a_second_encoder(pycrate: Any, seed: int) -> None:
    rng = np.random.default_rng(seed)
    n = int(rng.integers(0, 40))
    labels = rng.choice(["car", "bus", "agricultural", "pedestrian", "cyclist", "motorcycle", "tree"], n)
    data = encode(
        CollectivePerception(
            int(rng.integers(2**32)),
            float(rng.uniform(0, 4e9)),
            Boxes(
                rng.uniform(-100, 100, (n, 3)),
                rng.uniform(0.1, 30, (n, 3)),
                rng.uniform(-3, 3, n),
                rng.uniform(0, 1, n),
                rng.permutation(65535)[:n],
                labels,
            ),
            BODY if seed % 2 else None,
            heading=float(rng.uniform(-3, 3)),
            latitude=float(rng.uniform(-90, 90)),
            longitude=float(rng.uniform(-180, 180)),
            is_infrastructure=seed % 3 == 0,
            velocity=rng.normal(0, 10, (n, 2)),
            age=rng.uniform(0, 3, n),
            measurement_offset=rng.uniform(-0.3, 0, n),
            position_std=rng.uniform(0, 30, n),
            yaw_std=rng.uniform(0, 0.3, n),
        )
    )
    value = CPM.decode("CollectivePerceptionMessage", data)
    for container in value["payload"]["cpmContainers"]:
        name = CONTAINERS[container["containerId"]]
        container["containerData"] = (name, CPM.decode(name, container["containerData"]))
    codec = pycrate.CollectivePerceptionMessage
    codec.set_val(value)
    assert codec.to_uper() == data
    codec.from_uper(data)
    assert codec.get_val()["header"]["stationId"] == value["header"]["stationId"]


def test_fields_we_do_not_send_agree_too(pycrate: Any) -> None:
    """Other senders may send them, and what follows them would be read wrong."""
    angle = {"value": 900, "confidence": 5}
    acceleration = {"value": -3, "confidence": 4}
    full: dict[str, Any] = {
        "objectId": 1,
        "measurementDeltaTime": -100,
        "position": {f"{a}Coordinate": {"value": 7, "confidence": 9} for a in "xyz"},
        "velocity": (
            "polarVelocity",
            {
                "velocityMagnitude": {"speedValue": 1000, "speedConfidence": 3},
                "velocityDirection": angle,
                "zVelocity": {"value": 1, "confidence": 2},
            },
        ),
        "acceleration": (
            "cartesianAcceleration",
            {"xAcceleration": acceleration, "yAcceleration": acceleration, "zAcceleration": acceleration},
        ),
        "angles": {"zAngle": angle, "yAngle": angle, "xAngle": angle},
        "zAngularVelocity": {"value": -20, "confidence": "degSec-05"},
        "objectDimensionZ": {"value": 15, "confidence": 1},
        "objectDimensionY": {"value": 20, "confidence": 31},
        "objectDimensionX": {"value": 45, "confidence": 32},
        "objectAge": 1500,
        "objectPerceptionQuality": 15,
        "sensorIdList": [1, 2, 255],
        "classification": [
            {"objectClass": ("vehicleSubClass", 14), "confidence": 30},
            {"objectClass": ("vruSubClass", ("animal", "wild-animal")), "confidence": 40},
            {"objectClass": ("otherSubClass", 3), "confidence": 101},
        ],
        "mapPosition": {
            "mapReference": ("intersection", {"region": 3, "id": 4}),
            "laneId": 5,
            "longitudinalLanePosition": {
                "longitudinalLanePositionValue": 100,
                "longitudinalLanePositionConfidence": 1023,
            },
        },
    }
    polar = {
        "accelerationMagnitude": {"accelerationMagnitudeValue": 12, "accelerationConfidence": 102},
        "accelerationDirection": angle,
    }
    group = {"clusterId": 1, "clusterCardinalitySize": 3}
    other = full | {
        "acceleration": ("polarAcceleration", polar),
        "classification": [{"objectClass": ("groupSubClass", group), "confidence": 1}],
    }
    included, columns = 0b1100000000000, [[50], [-100, 101]]
    ours, theirs = (
        [
            value
            | {"lowerTriangularCorrelationMatrices": [{"componentsIncludedIntheMatrix": matrix, "matrix": columns}]}
            for value in (full, other)
        ]
        for matrix in (((included << 3).to_bytes(2, "big"), 13), (included, 13))
    )
    data = CPM.encode("PerceivedObjectContainer", {"numberOfPerceivedObjects": 2, "perceivedObjects": ours})
    codec = pycrate.PerceivedObjectContainer
    codec.set_val({"numberOfPerceivedObjects": 2, "perceivedObjects": theirs})
    assert codec.to_uper() == data
    trailer = {"refPointId": 1, "hitchPointOffset": 2, "trailerWidth": 30, "hitchAngle": angle}
    vehicle = {"orientationAngle": {"value": 1, "confidence": 1}, "pitchAngle": angle, "trailerDataSet": [trailer]}
    pycrate.OriginatingVehicleContainer.set_val(vehicle)
    assert pycrate.OriginatingVehicleContainer.to_uper() == CPM.encode("OriginatingVehicleContainer", vehicle)


@pytest.mark.parametrize(
    ("heading", "center", "yaw", "orientation", "east_north", "z_angle"),
    [
        (0.0, (10.0, 2.0), 0.0, 900, (1000, 200), 0),  # facing east, which is 90 degrees from north
        (90.0, (10.0, 2.0), 0.0, 0, (-200, 1000), 900),  # facing north: ahead is north, to the left is west
        (180.0, (10.0, 2.0), 90.0, 2700, (-1000, -200), 2700),  # facing west, the object faces left: south
        (-45.0, (10.0, 10.0), -45.0, 1350, (1414, 0), 2700),  # facing south-east
    ],
)
def test_angles_and_axes_of_the_standard(
    heading: float, center: Any, yaw: float, orientation: int, east_north: Any, z_angle: int
) -> None:
    box = boxes(1, center=[(*center, 0.5)], yaw=[math.radians(yaw)])
    containers = _containers(encode(message(boxes=box, heading=math.radians(heading))))
    assert containers["OriginatingVehicleContainer"]["orientationAngle"]["value"] == orientation
    (item,) = containers["PerceivedObjectContainer"]["perceivedObjects"]
    position = [item["position"][f"{axis}Coordinate"]["value"] for axis in "xyz"]
    assert position == [*east_north, 50]
    assert item["angles"]["zAngle"]["value"] == z_angle
    assert [item[f"objectDimension{axis}"]["value"] for axis in "XYZ"] == [45, 20, 15]


def test_heading_between_units_keeps_the_frame() -> None:
    """Turning by the exact heading and back by the sent one would move an object at 1 km by 0.87 m."""
    box = boxes(1, center=[(1000.0, 0.0, 0.0)])
    got = decode(encode(message(boxes=box, heading=math.radians(12.34999))))
    assert np.abs(got.boxes.center - box.center).max() < 0.008


def test_roadside_unit_arrives_in_east_and_north() -> None:
    box = boxes(1, center=[(10.0, 0.0, 0.0)], yaw=[0.0])
    got = decode(encode(message(boxes=box, heading=math.pi / 2, is_infrastructure=True)))
    assert got.is_infrastructure
    assert got.heading == 0.0
    np.testing.assert_allclose(got.boxes.center, [(0.0, 10.0, 0.0)], atol=1e-9)
    np.testing.assert_allclose(got.boxes.yaw, [math.pi / 2])


def test_velocity_is_sent_along_east_and_north() -> None:
    sent = message(boxes=boxes(2), heading=math.pi / 2, velocity=[(10.0, 0.0), (math.nan, 0.0)])
    first, second = _containers(encode(sent))["PerceivedObjectContainer"]["perceivedObjects"]
    kind, value = first["velocity"]
    assert (kind, value["xVelocity"]["value"], value["yVelocity"]["value"]) == ("cartesianVelocity", 0, 1000)
    assert "velocity" not in second
    got = decode(encode(sent)).velocity
    assert got is not None
    np.testing.assert_allclose(got, [(10.0, 0.0), (math.nan, math.nan)], atol=1e-9)


def test_confidence_is_the_95_percent_interval() -> None:
    (item,) = _containers(encode(message(boxes=boxes(1), position_std=[0.2], yaw_std=[math.radians(1.0)])))[
        "PerceivedObjectContainer"
    ]["perceivedObjects"]
    assert item["position"]["xCoordinate"]["confidence"] == 40  # 1.96 * 20 cm, rounded up
    assert item["angles"]["zAngle"]["confidence"] == 20
    got = decode(encode(message(boxes=boxes(1), position_std=[50.0])))
    assert got.position_std is not None
    assert got.position_std[0] == math.inf, "beyond the standard's range"


def test_large_objects_and_long_ages_saturate() -> None:
    got = decode(encode(message(boxes=boxes(1, size=[(40.0, 0.01, 2.0)]), age=[30.0])))
    np.testing.assert_allclose(got.boxes.size, [(25.5, 0.1, 2.0)])
    assert got.age is not None
    assert got.age[0] == 1.5


def test_labels_of_the_standard() -> None:
    sent = ["Car", "bicycle", "van", "unicorn", "vehicle"]
    got = decode(encode(message(boxes=boxes(5, label=sent)))).boxes
    assert got.label is not None
    assert got.label.tolist() == ["car", "cyclist", "van", "unknown", "vehicle"]


def test_track_ids_wrap_below_the_reserved_one() -> None:
    got = decode(encode(message(boxes=boxes(2, track_id=[65534, 65535])))).boxes
    assert got.track_id is not None
    assert got.track_id.tolist() == [65534, 0]


def test_objects_of_others_without_size_are_counted() -> None:
    containers = _containers(encode(message(boxes=boxes(4))))
    objects = containers["PerceivedObjectContainer"]["perceivedObjects"]
    del objects[0]["objectDimensionX"]
    objects[1]["objectDimensionY"]["value"] = 256
    objects[2]["angles"]["zAngle"]["value"] = 3601
    got = decode(_message(containers))
    assert (len(got.boxes), got.omitted) == (1, 3)


def test_polar_velocity_of_others_is_read() -> None:
    containers = _containers(encode(message(boxes=boxes(1))))
    direction = {"value": 900, "confidence": 127}
    speed = {"speedValue": 500, "speedConfidence": 127}
    containers["PerceivedObjectContainer"]["perceivedObjects"][0]["velocity"] = (
        "polarVelocity",
        {"velocityMagnitude": speed, "velocityDirection": direction},
    )
    got = decode(_message(containers)).velocity
    assert got is not None
    np.testing.assert_allclose(got, [(0.0, 5.0)], atol=1e-9)


def test_unknown_containers_are_skipped() -> None:
    whole = CPM.decode("CollectivePerceptionMessage", encode(message()))
    whole["payload"]["cpmContainers"].append({"containerId": 4, "containerData": b"\x01\x02\x03"})
    assert len(decode(CPM.encode("CollectivePerceptionMessage", whole)).boxes) == 2


def test_object_message_and_back() -> None:
    sent = ObjectMessage("42", 1.5, 15, boxes(), BODY)
    cpm = CollectivePerception.from_message(sent, heading=0.3)
    got = decode(encode(cpm)).object_message(frame=15)
    assert (got.agent_id, got.time, got.frame) == ("42", 1.5, 15)
    np.testing.assert_allclose(got.boxes.bev, sent.boxes.bev, atol=0.06)
    assert got.body is not None
    assert CollectivePerception.from_message(ObjectMessage("car1", 1.5, 15, boxes()), station_id=9).agent_id == "9"
    with pytest.raises(MessageError, match=r"agent_id must be a station id, .* got 'car1'"):
        CollectivePerception.from_message(ObjectMessage("car1", 1.5, 15, boxes()))


@pytest.mark.parametrize(
    ("make", "expected"),
    [
        (lambda: message(station_id=-1), "station_id must be from 0 to 4294967295, got -1"),
        (lambda: message(station_id="7"), "station_id must be a whole number"),
        (lambda: message(time=-1.0), "time must be from 0.0"),
        (lambda: message(time=math.nan), "time must be a finite number"),
        (lambda: message(latitude=91), "latitude must be from -90.0 to 90.0"),
        (lambda: message(altitude=9000), "altitude must be from -1000.0"),
        (lambda: message(boxes=None), "boxes must be Boxes"),
        (lambda: message(body=boxes(2)), "body must be Boxes with one row"),
        (lambda: message(boxes=boxes(MAX_OBJECTS), body=BODY), "boxes: 255 objects, a CPM holds at most 255 with"),
        (lambda: message(velocity=[1, 2]), r"velocity must have shape \(2, 2\), got \(2,\)"),
        (lambda: message(sensor_type="sonar"), "sensor_type must be one of undefined, radar"),
    ],
)
def test_field_outside_its_limits_is_named(make: Callable[[], Any], expected: str) -> None:
    with pytest.raises(MessageError, match=expected):
        make()


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"boxes": boxes(track_id=None)}, "boxes must have a track_id"),
        ({"boxes": boxes(track_id=[3, -3])}, "track_id: row 1 is -3"),
        ({"boxes": boxes(track_id=[3, 3 + OWN_VEHICLE])}, "two ids are the same modulo 65535"),
        ({"boxes": boxes(center=[(0, 0, 0), (0, 1400, 0)])}, r"center \(east, north, up\): row 1 .* at most 1310.7"),
        ({"boxes": boxes(score=[0.5, 1.5])}, "score: row 1 is 1.5, a CPM holds scores from 0 to 1"),
        ({"velocity": [(0, 0), (200, 0)]}, r"velocity: row 1 .* at most 163.81"),
        ({"age": [1, -1]}, "age: row 1 is -1.0"),
        ({"measurement_offset": [0, 5]}, r"measurement_offset: row 1 is 5.0, .* at most 2.046"),
        ({"position_std": [-1, 0]}, "standard deviations must be >= 0, row 0 is -1.0"),
        ({"body": BODY.replace(center=[(9, 0, 0)])}, "body must be located at the origin"),
        ({"is_infrastructure": True}, "heading: required for a roadside unit"),
    ],
)
def test_values_beyond_limits_are_not_encoded(changes: dict[str, Any], expected: str) -> None:
    with pytest.raises(MessageError, match=expected):
        encode(message(**changes))


def test_any_truncation_or_tail_is_an_error() -> None:
    data = encode(message(body=BODY))
    for length in range(len(data)):
        with pytest.raises(MessageError):
            decode(data[:length])
    for tail in (b"\0", b"\xff" * 9):
        with pytest.raises(MessageError, match="oversized"):
            decode(data + tail)


@given(st.binary(max_size=200) | st.binary(max_size=200).map(lambda tail: bytes([2, 14]) + tail))
@settings(max_examples=300, deadline=None)
def test_any_bytes_decode_or_raise_message_error(data: bytes) -> None:
    _decodes_or_is_refused(data)


@given(messages(), st.lists(st.tuples(st.integers(0, 2000), st.integers(0, 255)), min_size=1, max_size=4))
@settings(max_examples=300, deadline=None)
def test_damaged_messages_decode_or_raise_message_error(
    sent: CollectivePerception, changes: list[tuple[int, int]]
) -> None:
    data = bytearray(encode(sent))
    for position, value in changes:
        data[position % len(data)] = value
    _decodes_or_is_refused(bytes(data))


@pytest.mark.parametrize(
    ("change", "expected"),
    [
        (lambda m: m["header"].update(messageId=2), "not a CPM of version 2: it has messageId 2"),
        (lambda m: m["header"].update(protocolVersion=1), "not a CPM .* protocolVersion 1"),
        (lambda m: m["payload"]["cpmContainers"].append(m["payload"]["cpmContainers"][0]), "container 1 comes twice"),
        (
            lambda m: m["payload"]["cpmContainers"].append({"containerId": 2, "containerData": b"\0"}),
            "a vehicle and a roadside unit at once",
        ),
    ],
)
def test_message_of_another_kind_is_refused(change: Callable[[Any], None], expected: str) -> None:
    whole = CPM.decode("CollectivePerceptionMessage", encode(message()))
    change(whole)
    with pytest.raises(MessageError, match=expected):
        decode(CPM.encode("CollectivePerceptionMessage", whole))


def test_two_objects_with_one_id_are_refused() -> None:
    containers = _containers(encode(message()))
    for item in containers["PerceivedObjectContainer"]["perceivedObjects"]:
        item["objectId"] = 3
    with pytest.raises(MessageError, match="invalid boxes: track_id: rows 0 and 1 have the same id 3"):
        decode(_message(containers))


@pytest.mark.parametrize("data", ["text", None, 5])
def test_non_bytes_raise_a_message_error(data: Any) -> None:
    with pytest.raises(MessageError, match="a message is bytes"):
        decode(data)


def _containers(data: bytes) -> dict[str, Any]:
    whole = CPM.decode("CollectivePerceptionMessage", data)
    return {
        CONTAINERS[c["containerId"]]: CPM.decode(CONTAINERS[c["containerId"]], c["containerData"])
        for c in whole["payload"]["cpmContainers"]
    }


def _message(containers: dict[str, Any]) -> bytes:
    """The bytes of `message()` with these containers."""
    whole = CPM.decode("CollectivePerceptionMessage", encode(message()))
    numbers = {name: number for number, name in CONTAINERS.items()}
    whole["payload"]["cpmContainers"] = [
        {"containerId": numbers[name], "containerData": CPM.encode(name, value)} for name, value in containers.items()
    ]
    return CPM.encode("CollectivePerceptionMessage", whole)


def _decodes_or_is_refused(data: bytes) -> None:
    try:
        got = decode(data)
    except MessageError:
        return
    assert np.isfinite(got.boxes.bev).all()
    assert (got.boxes.size[:, :2] > 0).all()


def _close(got: Any, sent: Any, within: float, angle: bool = False) -> None:
    assert (got is None) == (sent is None)
    if sent is not None and np.size(sent):
        gap = np.asarray(got) - np.asarray(sent)
        assert np.abs(wrap_angle(gap) if angle else gap).max() <= within


def _close_where_known(got: Any, sent: Any, within: float) -> None:
    if sent is None or np.isnan(sent).all():
        assert got is None
        return
    np.testing.assert_allclose(got, sent, atol=within, rtol=0)
