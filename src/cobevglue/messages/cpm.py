"""ETSI's Collective Perception Message (CPM, TS 103 324 V2.1.1), an alternative to the package's object message.

    data = encode(CollectivePerception(station_id=7, time=t, boxes=boxes, heading=yaw_from_east))
    decode(data).boxes  # in the sender's frame again

The types are defined in `cpm.asn` and encoded in unaligned PER. Requires: pip install 'cobevglue[cpm]'

Content of the fields:

| field of the standard | content | unit |
|---|---|---|
| referenceTime | `time` | 1 ms |
| referencePosition | `latitude`, `longitude`, `altitude` of the frame's origin | 1e-7 degree, 0.01 m |
| orientationAngle | `heading`, converted to clockwise from north; vehicles only | 0.1 degree |
| objectId | track id modulo 65535, which the standard requires; 65535 is the sender's own vehicle | |
| measurementDeltaTime | `measurement_offset` | 1 ms |
| position | box centre relative to the reference position: east, north, up | 0.01 m, up to 1310.7 m |
| velocity | `velocity`, east and north | 0.01 m/s |
| zAngle | yaw, counter-clockwise from east | 0.1 degree |
| objectDimensionX, Y, Z | length, width, height; a height of 0 (unknown) is left out | 0.1 m, up to 25.4 m |
| objectAge | `age`; 1.5 s for more | 1 ms |
| objectPerceptionQuality | score | 1/15 |
| classification | label | |

- Values are rounded to the nearest multiple of their unit. Rounding up, as in the standard's tables, would cause a bias
  of half a unit in receivers that multiply by the unit.
- Objects are rotated by the heading after its rounding to 0.1 degree, so that this rounding causes no error when the
  receiver restores the sender's frame.
- **Without GNSS**: latitude, longitude and `heading` of None are sent as unavailable, and coordinates are along the
  sender's own axes. A receiver cannot place such a list on a map; BEVGlue does not need a map position.
- The standard defines no heading for a roadside unit. Its boxes are decoded along the axes east and north, with
  `heading` 0.
- A standard CPM does not contain the sender's own box (the CAM contains its size). `body` is sent as an additional
  object with the id 65535 at the reference position; other receivers decode it as an ordinary object.
- Received objects without length, width or zAngle cannot be represented as boxes; `omitted` is their number.
- One message contains at most 255 objects; segmentation is not implemented. A CPM has no checksum: its integrity is
  protected by the signature of the surrounding packet (TS 103 097).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

from cobevglue.boxes import Boxes
from cobevglue.messages.asn1_codec import CPM
from cobevglue.messages.columns import Columns
from cobevglue.messages.cpm_objects import objects_from_columns, read_objects
from cobevglue.messages.fields import check_range, check_station_id, column, sent_ids, station_id_of, whole_bytes
from cobevglue.messages.object_message import MessageError, ObjectMessage
from cobevglue.typing import FloatArray

__all__ = ["MAX_OBJECTS", "OWN_VEHICLE", "SENSOR_TYPES", "CollectivePerception", "decode", "encode"]

MAX_OBJECTS = 255
"""Maximum number of objects in one message, including the own vehicle."""
OWN_VEHICLE = 65535
"""objectId of the sender's own vehicle; track ids are taken modulo this number."""
SENSOR_TYPES = (
    "undefined", "radar", "lidar", "monovideo", "stereovision", "nightvision", "ultrasonic", "pmd", "inductionLoop",
    "sphericalCamera", "uwb", "acoustic", "localAggregation", "itsAggregation",
)  # fmt: skip
"""Names of the standard's sensor types, by number."""

_PROTOCOL_VERSION, _CPM = 2, 14
_VEHICLE, _ROADSIDE, _SENSORS, _OBJECTS = 1, 2, 3, 5
_MAX_TIME = (2**42 - 1) / 1000.0
_NO_LATITUDE, _NO_LONGITUDE, _NO_ALTITUDE, _NO_ANGLE = 900_000_001, 1_800_000_001, 800_001, 3601


@dataclass(frozen=True, eq=False, slots=True)
class CollectivePerception:
    """Content of a CPM: the objects that one agent observed at one time.

    Attributes:
        station_id: the sender, 0 to 2^32 - 1.
        time: time stamp of the list [s], 0 to 4.4e9: seconds since 2004-01-01 UTC including leap seconds (5 s ahead of
            UTC since 2017), or simulation time.
        boxes: the objects in the sender's own frame, with `track_id`. Scores must be from 0 to 1.
        body: one-row box of the sender's own vehicle in the same frame, located at its origin; or None.
        heading: yaw of the frame's x axis, counter-clockwise from east [rad]; None for unknown.
        latitude: latitude of the frame's origin [degrees]; None for unknown.
        longitude: longitude of the frame's origin [degrees]; None for unknown.
        altitude: altitude of the frame's origin [m]; None for unknown.
        is_infrastructure: whether the sender is a roadside unit.
        velocity: (N, 2) velocities over ground along the axes of the frame [m/s], NaN where unknown; or None.
        age: (N,) time since each object was first observed [s], NaN where unknown; or None.
        measurement_offset: (N,) measurement time of each object relative to `time` [s]; None if all are 0.
        position_std: (N,) standard deviations of x and y [m], NaN where unknown; or None. Sent as the 95 % interval.
        yaw_std: (N,) standard deviations of the yaw [rad], NaN where unknown; or None. Sent as the 95 % interval.
        sensor_type: a name in `SENSOR_TYPES`, or None to send no sensor information. Not read from received messages.
        omitted: number of received objects without size or heading.

    Raises:
        MessageError: a field is out of range; the error names the field and the row.
    """

    station_id: int
    time: float
    boxes: Boxes
    body: Boxes | None = None
    heading: float | None = None
    latitude: float | None = None
    longitude: float | None = None
    altitude: float | None = None
    is_infrastructure: bool = False
    velocity: FloatArray | None = None
    age: FloatArray | None = None
    measurement_offset: FloatArray | None = None
    position_std: FloatArray | None = None
    yaw_std: FloatArray | None = None
    sensor_type: str | None = "lidar"
    omitted: int = 0

    def __post_init__(self) -> None:
        check_station_id(self.station_id)
        check_range("time", self.time, 0.0, _MAX_TIME)
        for name, limit in (("latitude", 90.0), ("longitude", 180.0), ("heading", math.inf)):
            if getattr(self, name) is not None:
                check_range(name, getattr(self, name), -limit, limit)
        if self.altitude is not None:
            check_range("altitude", self.altitude, -1000.0, 8000.0)
        if not isinstance(self.boxes, Boxes):
            raise MessageError(f"boxes must be Boxes, got {type(self.boxes).__name__}")
        if self.body is not None and (not isinstance(self.body, Boxes) or len(self.body) != 1):
            raise MessageError(f"body must be Boxes with one row, got {self.body!r}")
        if len(self.boxes) + (self.body is not None) > MAX_OBJECTS:
            raise MessageError(f"boxes: {len(self.boxes)} objects, a CPM holds at most {MAX_OBJECTS} with the body")
        if self.sensor_type is not None and self.sensor_type not in SENSOR_TYPES:
            raise MessageError(f"sensor_type must be one of {', '.join(SENSOR_TYPES)}, got {self.sensor_type!r}")
        n = len(self.boxes)
        for name, shape in (
            ("velocity", (n, 2)),
            ("age", (n,)),
            ("measurement_offset", (n,)),
            ("position_std", (n,)),
            ("yaw_std", (n,)),
        ):
            object.__setattr__(self, name, column(name, getattr(self, name), shape))

    @property
    def agent_id(self) -> str:
        """Sender id as in an `ObjectMessage`: the station id as text."""
        return str(self.station_id)

    @classmethod
    def from_message(cls, message: ObjectMessage, **fields: Any) -> CollectivePerception:
        """Convert an object message to a CPM.

        Args:
            message: the object message. Its agent id must be the station id as text, unless `station_id` is given.
            fields: further fields, such as `heading` and `velocity`.

        Raises:
            MessageError: the agent id is not a number, or a field is out of range.
        """
        if "station_id" not in fields:
            fields["station_id"] = station_id_of(message)
        return cls(time=message.time, boxes=message.boxes, body=message.body, **fields)

    def object_message(self, frame: int = 0) -> ObjectMessage:
        """Convert to an object message. A CPM has no frame count, so the caller provides it."""
        return ObjectMessage(self.agent_id, self.time, frame, self.boxes, self.body)


def encode(message: CollectivePerception) -> bytes:
    """Encode a CPM.

    Raises:
        MessageError: a field that the standard requires is missing, or a value is out of range; the error names field
            and row.
        ModuleNotFoundError: asn1tools is not installed.
    """
    if message.is_infrastructure and message.heading is None:
        raise MessageError("heading: required for a roadside unit, whose CPM cannot mark it as unavailable")
    angle, orientation = _sent_heading(message)
    objects = objects_from_columns(_columns(message), angle)
    containers = [(_ROADSIDE, CPM.encode("OriginatingRsuContainer", {}))]
    if not message.is_infrastructure:
        container = {"orientationAngle": {"value": orientation, "confidence": 127}}
        containers = [(_VEHICLE, CPM.encode("OriginatingVehicleContainer", container))]
    if message.sensor_type is not None:
        sensor = {"sensorId": 1, "sensorType": SENSOR_TYPES.index(message.sensor_type), "shadowingApplies": False}
        containers.append((_SENSORS, CPM.encode("SensorInformationContainer", [sensor])))
    perceived = {"numberOfPerceivedObjects": len(objects), "perceivedObjects": objects}
    containers.append((_OBJECTS, CPM.encode("PerceivedObjectContainer", perceived)))
    payload = {
        "managementContainer": {
            "referenceTime": round(1000.0 * message.time),
            "referencePosition": _reference_position(message),
        },
        "cpmContainers": [{"containerId": number, "containerData": data} for number, data in containers],
    }
    header = {"protocolVersion": _PROTOCOL_VERSION, "messageId": _CPM, "stationId": int(message.station_id)}
    return CPM.encode("CollectivePerceptionMessage", {"header": header, "payload": payload})


def decode(data: bytes | bytearray | memoryview) -> CollectivePerception:
    """Decode a CPM.

    Sensor information, perception regions and object fields without an attribute in `CollectivePerception` are ignored.

    Raises:
        MessageError: the bytes are not exactly one CPM with valid boxes; the error gives the reason.
        ModuleNotFoundError: asn1tools is not installed.
    """
    data = whole_bytes(data)
    whole = CPM.decode("CollectivePerceptionMessage", data)
    if CPM.has_spare_bytes("CollectivePerceptionMessage", data):
        raise MessageError(f"oversized: {len(data)} bytes, the CPM ends before")
    header, payload = whole["header"], whole["payload"]
    if (header["protocolVersion"], header["messageId"]) != (_PROTOCOL_VERSION, _CPM):
        raise MessageError(
            f"not a CPM of version {_PROTOCOL_VERSION}: it has messageId {header['messageId']} and protocolVersion "
            f"{header['protocolVersion']}"
        )
    containers: dict[int, bytes] = {}
    for container in payload["cpmContainers"]:
        if container["containerId"] in containers:
            raise MessageError(f"container {container['containerId']} comes twice")
        containers[container["containerId"]] = container["containerData"]
    if _VEHICLE in containers and _ROADSIDE in containers:
        raise MessageError("the sender is a vehicle and a roadside unit at once")
    heading: float | None = 0.0
    if _ROADSIDE not in containers:
        heading = _received_heading(containers.get(_VEHICLE))
    objects = []
    if _OBJECTS in containers:
        objects = CPM.decode("PerceivedObjectContainer", containers[_OBJECTS])["perceivedObjects"]
    try:
        columns, omitted = read_objects(objects, heading or 0.0)
    except ValueError as error:
        raise MessageError(f"invalid boxes: {error}") from None
    columns, body = columns.split_own_vehicle(OWN_VEHICLE)
    management = payload["managementContainer"]
    position = management["referencePosition"]
    return CollectivePerception(
        station_id=header["stationId"],
        time=management["referenceTime"] / 1000.0,
        boxes=columns.boxes,
        body=body,
        heading=heading,
        latitude=_known(position["latitude"], _NO_LATITUDE, 1e-7),
        longitude=_known(position["longitude"], _NO_LONGITUDE, 1e-7),
        altitude=_known(position["altitude"]["altitudeValue"], _NO_ALTITUDE, 0.01),
        is_infrastructure=_ROADSIDE in containers,
        velocity=columns.velocity,
        age=columns.age,
        measurement_offset=columns.measurement_offset,
        position_std=columns.position_std,
        yaw_std=columns.yaw_std,
        sensor_type=None,
        omitted=omitted,
    )


def _sent_heading(message: CollectivePerception) -> tuple[float, int]:
    """Return the rotation from the sender's axes to those of the message [rad], and the orientationAngle."""
    if message.heading is None:
        return 0.0, _NO_ANGLE
    if message.is_infrastructure:
        return message.heading, _NO_ANGLE
    orientation = round(900.0 - 10.0 * math.degrees(message.heading)) % 3600
    return _heading_of(orientation), orientation


def _received_heading(vehicle: bytes | None) -> float | None:
    if vehicle is None:
        return None
    orientation = CPM.decode("OriginatingVehicleContainer", vehicle)["orientationAngle"]["value"]
    return None if orientation == _NO_ANGLE else _heading_of(orientation)


def _heading_of(orientation: int) -> float:
    """Convert tenths of degrees clockwise from north to radians counter-clockwise from east, in (-pi, pi]."""
    tenths = (900 - orientation) % 3600
    return math.radians((tenths - 3600 if tenths > 1800 else tenths) / 10.0)


def _reference_position(message: CollectivePerception) -> dict[str, Any]:
    altitude = _NO_ALTITUDE if message.altitude is None else round(100.0 * message.altitude)
    return {
        "latitude": _NO_LATITUDE if message.latitude is None else round(1e7 * message.latitude),
        # The value for -180 degrees is reserved.
        "longitude": _NO_LONGITUDE
        if message.longitude is None
        else max(round(1e7 * message.longitude), -1_799_999_999),
        "positionConfidenceEllipse": {
            "semiMajorConfidence": 4095,
            "semiMinorConfidence": 4095,
            "semiMajorOrientation": _NO_ANGLE,
        },
        "altitude": {"altitudeValue": altitude, "altitudeConfidence": "unavailable"},
    }


def _columns(message: CollectivePerception) -> Columns:
    """Return the objects and, as the last row, the own vehicle."""
    boxes = message.boxes
    if len(boxes) and boxes.track_id is None:
        raise MessageError("boxes must have a track_id, since the standard requires objectId: use a tracker")
    ids = sent_ids(boxes, OWN_VEHICLE)
    columns = Columns(
        boxes.replace(track_id=ids),
        message.velocity,
        message.age,
        message.measurement_offset,
        message.position_std,
        message.yaw_std,
    )
    if message.body is None:
        return columns
    return columns.with_own_vehicle(message.body, OWN_VEHICLE)


def _known(value: int, unavailable: int, unit: float) -> float | None:
    return None if value == unavailable else value * unit
