"""SAE's Sensor Data Sharing Message (SDSM, J3224) in place of our own object message.

    data = encode(SensorDataSharing(station_id=7, time=unix_time, boxes=boxes, heading=yaw_from_east))
    decode(data).boxes  # in axes east and north

The types are in `sdsm.asn`, encoded in unaligned PER inside of a J2735 MessageFrame. The standard was not at hand: that
file says what was checked and how. Needs: pip install 'cobevglue[cpm]'

How the fields are filled:

| field of the standard | content | unit |
|---|---|---|
| sourceID | `station_id`, most significant byte first | |
| sDSMTimeStamp | `time`, as a date and time in UTC | 1 ms |
| refPos | `latitude`, `longitude`, `altitude` of the frame's origin | 1e-7 degree, 0.1 m |
| objectID | track id modulo 65535; 65535 is the sender's own vehicle | |
| measurementTime | `measurement_offset`, up to 1.5 s | 1 ms |
| pos | box centre east, north and above of the reference position | 0.1 m, up to 3276.7 m |
| heading | yaw, clockwise from north; turned by half a turn if the object moves backwards | 0.0125 degree |
| speed | of `velocity`, the component along yaw | 0.02 m/s |
| detVeh: size, height | length, width, height; a height of 0 (unknown) is left out | 0.01 m, 0.05 m |
| detObst: obstSize | the same for the labels "pedestrian" and "animal" | 0.1 m |
| objType | label: "vehicle" for all kinds of them, "pedestrian" for all vulnerable road users, "animal", "unknown" | |
| objTypeCfd | score | 1 % |

- Values are rounded to the nearest multiple of their unit.
- A sender has no heading in the standard. Its boxes arrive in axes east and north, with `heading` 0.
- **Without GNSS**: latitude, longitude and `heading` of None are sent as an unavailable position, and coordinates are
  along the sender's own axes: a profile of ours, as for the CPM.
- An object has a direction of motion and a speed, and no other velocity: what is across of yaw is not sent.
- `body` is sent as one more object, as in a CPM. Confidences are sent as unavailable, and not read.
- Not confirmed for want of the standard: that x is east and y is north, the sign of measurementTime (positive: after
  the time stamp, here), and that objects other than obstacles may have a size in detObst.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from typing import Any

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.messages.asn1_codec import SDSM
from cobevglue.messages.columns import Columns
from cobevglue.messages.fields import (
    check_range,
    check_station_id,
    column,
    rounded,
    sent_ids,
    station_id_of,
    whole_bytes,
    whole_units,
)
from cobevglue.messages.object_message import MessageError, ObjectMessage
from cobevglue.se2 import SE2, wrap_angle
from cobevglue.typing import FloatArray

__all__ = ["MAX_OBJECTS", "OWN_VEHICLE", "SensorDataSharing", "decode", "encode"]

MAX_OBJECTS = 256
"""Most objects of one message, the own vehicle included; there is at least one."""
OWN_VEHICLE = 65535
"""objectID of the sender's own vehicle; track ids are taken modulo this number."""

_SDSM = 41
_EPOCH = datetime(1970, 1, 1, tzinfo=timezone.utc)
_MAX_TIME = (datetime(4096, 1, 1, tzinfo=timezone.utc) - _EPOCH).total_seconds() - 1.0
_NO_LATITUDE, _NO_LONGITUDE, _NO_ELEVATION = 900_000_001, 1_800_000_001, -4096
_DECIMETRE, _CENTIMETRE, _MILLISECOND, _SPEED_UNIT, _HEIGHT_UNIT = 0.1, 0.01, 0.001, 0.02, 0.05
_HEADING_UNIT, _TURN = math.radians(0.0125), 28800
_MAX_COORDINATE, _MAX_OFFSET, _MAX_SPEED, _NO_SPEED, _NO_CONFIDENCE = 32767, 1500, 8190, 8191, 101
_MAX_WIDTH, _MAX_LENGTH, _MAX_HEIGHT, _MAX_OBSTACLE = 1023, 4095, 127, 1023
_TYPES = {
    "vehicle": ("vehicle", "car", "bus", "van", "truck", "trailer", "special vehicle", "tram", "agricultural"),
    "vru": ("pedestrian", "person", "cyclist", "bicycle", "bicyclist", "motorcycle", "motorcyclist"),
    "animal": ("animal",),
}
"""Labels by objType; a received object gets the first."""


@dataclass(frozen=True, eq=False, slots=True)
class SensorDataSharing:
    """What one agent saw at one time, as an SDSM holds it.

    Attributes:
        station_id: the sender, 0 to 2^32 - 1: the four bytes of the temporary id.
        time: of the list [s], since 1970-01-01 UTC, without leap seconds.
        boxes: the objects, 1 to 256 with the body, in the sender's own frame, with `track_id`. Scores are from 0 to 1.
        body: one-row box of the sender's own vehicle in the same frame, which stands on its origin; or None.
        heading: yaw of the frame's x axis, counter-clockwise from east [rad]; None for unknown.
        latitude: of the frame's origin [degrees], with `longitude` and `heading`; None for unknown.
        longitude: likewise.
        altitude: likewise [m].
        is_infrastructure: whether the sender is a roadside unit.
        message_count: 0 to 127, one more in each message.
        velocity: (N, 2) velocities over ground along the axes of the frame [m/s], NaN where unknown; or None.
        measurement_offset: (N,) when the objects were measured, relative to `time` [s]; None for at `time`.
        omitted: objects of a received message that had no size or heading.

    Raises:
        MessageError: a field is outside of its limits; it names the field and the row.
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
    message_count: int = 0
    velocity: FloatArray | None = None
    measurement_offset: FloatArray | None = None
    omitted: int = 0

    def __post_init__(self) -> None:
        check_station_id(self.station_id)
        check_range("time", self.time, 0.0, _MAX_TIME)
        check_range("message_count", self.message_count, 0, 127)
        for name, low, high in (
            ("latitude", -90.0, 90.0),
            ("longitude", -180.0, 180.0),
            ("altitude", -409.5, 6143.9),
            ("heading", -math.inf, math.inf),
        ):
            if getattr(self, name) is not None:
                check_range(name, getattr(self, name), low, high)
        if (self.latitude is None) != (self.longitude is None):
            raise MessageError("latitude and longitude must be given both or not at all")
        if self.latitude is not None and self.heading is None:
            raise MessageError("heading: it must be known with a latitude, since an SDSM cannot say that it is unknown")
        if not isinstance(self.boxes, Boxes):
            raise MessageError(f"boxes must be Boxes, got {type(self.boxes).__name__}")
        if self.body is not None and (not isinstance(self.body, Boxes) or len(self.body) != 1):
            raise MessageError(f"body must be Boxes with one row, got {self.body!r}")
        n = len(self.boxes)
        if n + (self.body is not None) > MAX_OBJECTS:
            raise MessageError(f"boxes: {n} objects, an SDSM holds at most {MAX_OBJECTS} with the body")
        for name, shape in (("velocity", (n, 2)), ("measurement_offset", (n,))):
            object.__setattr__(self, name, column(name, getattr(self, name), shape))

    @property
    def agent_id(self) -> str:
        """The sender, as in an `ObjectMessage`: the station id as text."""
        return str(self.station_id)

    @classmethod
    def from_message(cls, message: ObjectMessage, **fields: Any) -> SensorDataSharing:
        """The SDSM of an object message.

        Args:
            message: its agent id is the station id as text, unless `station_id` is given.
            fields: further fields, such as `heading` and `velocity`.

        Raises:
            MessageError: the agent id is not a number, or a field is outside of its limits.
        """
        if "station_id" not in fields:
            fields["station_id"] = station_id_of(message)
        return cls(time=message.time, boxes=message.boxes, body=message.body, **fields)

    def object_message(self, frame: int = 0) -> ObjectMessage:
        """The object message of this SDSM; an SDSM has no frame count, so the caller gives it."""
        return ObjectMessage(self.agent_id, self.time, frame, self.boxes, self.body)


def encode(message: SensorDataSharing) -> bytes:
    """The bytes of a MessageFrame with an SDSM.

    Raises:
        MessageError: there is no object, one has no track id, or a value is out of its range; it names field and row.
        ModuleNotFoundError: asn1tools is not installed.
    """
    boxes = message.boxes
    if len(boxes) and boxes.track_id is None:
        raise MessageError("boxes must have a track_id, since the standard requires objectID: use a tracker")
    if len(boxes) == 0 and message.body is None:
        raise MessageError("boxes: an SDSM holds at least one object")
    columns = Columns(
        boxes.replace(track_id=sent_ids(boxes, OWN_VEHICLE)),
        velocity=message.velocity,
        measurement_offset=message.measurement_offset,
    )
    if message.body is not None:
        columns = columns.with_own_vehicle(message.body, OWN_VEHICLE)
    position = {"lat": _NO_LATITUDE, "long": _NO_LONGITUDE}
    if message.latitude is not None and message.longitude is not None:
        # -180 degrees itself has no number.
        longitude = max(round(1e7 * message.longitude), -1_799_999_999)
        position = {"lat": round(1e7 * message.latitude), "long": longitude}
    if message.altitude is not None:
        position["elevation"] = round(message.altitude / _DECIMETRE)
    value = {
        "msgCnt": int(message.message_count),
        "sourceID": int(message.station_id).to_bytes(4, "big"),
        "equipmentType": "rsu" if message.is_infrastructure else "obu",
        "sDSMTimeStamp": _date(message.time),
        "refPos": position,
        "refPosXYConf": {"semiMajor": 255, "semiMinor": 255, "orientation": 65535},
        "objects": _objects(columns, message.heading or 0.0),
    }
    data = SDSM.encode("SensorDataSharingMessage", value)
    return SDSM.encode("MessageFrame", {"messageId": _SDSM, "value": data})


def decode(data: bytes | bytearray | memoryview) -> SensorDataSharing:
    """The SDSM in these bytes of a MessageFrame.

    Raises:
        MessageError: these are not exactly one SDSM with a complete time stamp and valid boxes; it says why.
        ModuleNotFoundError: asn1tools is not installed.
    """
    data = whole_bytes(data)
    frame = SDSM.decode("MessageFrame", data)
    if frame["messageId"] != _SDSM:
        raise MessageError(f"not an SDSM: it has messageId {frame['messageId']}, not {_SDSM}")
    value = SDSM.decode("SensorDataSharingMessage", frame["value"])
    if SDSM.has_spare_bytes("MessageFrame", data) or SDSM.has_spare_bytes("SensorDataSharingMessage", frame["value"]):
        raise MessageError(f"oversized: {len(data)} bytes, the SDSM ends before")
    position = value["refPos"]
    if "regional" in position:
        raise MessageError("refPos has a regional extension, which is not known")
    unknown = position["lat"] == _NO_LATITUDE or position["long"] == _NO_LONGITUDE
    elevation = position.get("elevation", _NO_ELEVATION)
    try:
        columns, omitted = _read_objects(value["objects"])
    except ValueError as error:
        raise MessageError(f"invalid boxes: {error}") from None
    columns, body = columns.split_own_vehicle(OWN_VEHICLE)
    return SensorDataSharing(
        station_id=int.from_bytes(value["sourceID"], "big"),
        time=_time(value["sDSMTimeStamp"]),
        boxes=columns.boxes,
        body=body,
        heading=None if unknown else 0.0,
        latitude=None if unknown else position["lat"] * 1e-7,
        longitude=None if unknown else position["long"] * 1e-7,
        altitude=None if elevation == _NO_ELEVATION else elevation * _DECIMETRE,
        is_infrastructure=value["equipmentType"] == "rsu",
        message_count=value["msgCnt"],
        velocity=columns.velocity,
        measurement_offset=columns.measurement_offset,
        omitted=omitted,
    )


def _date(time: float) -> dict[str, int]:
    """The time as a DDateTime in UTC."""
    when = _EPOCH + timedelta(milliseconds=round(time / _MILLISECOND))
    return {
        "year": when.year,
        "month": when.month,
        "day": when.day,
        "hour": when.hour,
        "minute": when.minute,
        "second": 1000 * when.second + when.microsecond // 1000,
        "offset": 0,
    }


def _time(date: dict[str, int]) -> float:
    """Seconds since 1970 of a DDateTime; MessageError if it is not complete."""
    try:
        start = datetime(date["year"], date["month"], date["day"], date["hour"], date["minute"], tzinfo=timezone.utc)
        milliseconds = date["second"]
    except (KeyError, ValueError):
        raise MessageError(f"sDSMTimeStamp is not a complete date and time: {date}") from None
    if start < _EPOCH or milliseconds >= 61_000:  # a leap second is the 61st
        raise MessageError(f"sDSMTimeStamp is not a date and time since 1970: {date}")
    whole = (start - _EPOCH - timedelta(minutes=date.get("offset", 0))) / timedelta(milliseconds=1)
    return (whole + milliseconds) * _MILLISECOND


def _objects(columns: Columns, heading: float) -> list[dict[str, Any]]:
    """The `DetectedObjectData`s; `heading` is of the sender's x axis in the axes of the message [rad]."""
    boxes = columns.boxes.transform(SE2(0.0, 0.0, heading))
    n = len(boxes)
    centers = whole_units("center (east, north, up)", boxes.center, _DECIMETRE, _MAX_COORDINATE, "an SDSM")
    offsets = np.zeros(n, np.int64)
    if columns.measurement_offset is not None:
        offsets = whole_units("measurement_offset", columns.measurement_offset, _MILLISECOND, _MAX_OFFSET, "an SDSM")
    along = np.full(n, math.nan)
    if columns.velocity is not None:
        yaw = columns.boxes.yaw
        along = columns.velocity[:, 0] * np.cos(yaw) + columns.velocity[:, 1] * np.sin(yaw)
    known = ~np.isnan(along)
    speeds = whole_units("velocity along yaw", np.where(known, along, 0.0), _SPEED_UNIT, _MAX_SPEED, "an SDSM")
    headings = rounded((math.pi / 2 - boxes.yaw + math.pi * (speeds < 0)) / _HEADING_UNIT) % _TURN
    confidences = np.full(n, _NO_CONFIDENCE)
    if boxes.score is not None:
        outside = (boxes.score < 0) | (boxes.score > 1)
        if outside.any():
            row = int(outside.argmax())
            raise MessageError(f"score: row {row} is {boxes.score[row]}, an SDSM holds scores from 0 to 1 only")
        confidences = rounded(100.0 * boxes.score)
    assert boxes.track_id is not None
    objects = []
    for row, (x, y, z) in enumerate(centers.tolist()):
        kind = "unknown" if boxes.label is None else _type_of(boxes.label[row])
        common = {
            "objType": kind,
            "objTypeCfd": int(confidences[row]),
            "objectID": int(boxes.track_id[row]),
            "measurementTime": int(offsets[row]),
            "timeConfidence": 0,
            "pos": {"offsetX": x, "offsetY": y, "offsetZ": z},
            "posConfidence": {"pos": 0, "elevation": 0},
            "speed": abs(int(speeds[row])) if known[row] else _NO_SPEED,
            "speedConfidence": 0,
            "heading": int(headings[row]),
            "headingConf": 0,
        }
        objects.append({"detObjCommon": common, "detObjOptData": _sent_size(kind, boxes.size[row])})
    return objects


def _sent_size(kind: str, size: FloatArray) -> tuple[str, dict[str, Any]]:
    """The detObjOptData: what is too large for it gets the largest number."""

    def units(value: float, unit: float, most: int) -> int:
        return int(np.clip(round(value / unit), 1, most))

    length, width, height = size.tolist()
    if kind in ("vru", "animal"):
        obstacle = {
            "width": units(width, _DECIMETRE, _MAX_OBSTACLE),
            "length": units(length, _DECIMETRE, _MAX_OBSTACLE),
        }
        confidence = {"widthConfidence": 0, "lengthConfidence": 0}
        if height > 0:
            obstacle["height"] = units(height, _DECIMETRE, _MAX_OBSTACLE)
            confidence["heightConfidence"] = 0
        return "detObst", {"obstSize": obstacle, "obstSizeConfidence": confidence}
    vehicle: dict[str, Any] = {
        "size": {"width": units(width, _CENTIMETRE, _MAX_WIDTH), "length": units(length, _CENTIMETRE, _MAX_LENGTH)}
    }
    if height > 0:
        vehicle["height"] = units(height, _HEIGHT_UNIT, _MAX_HEIGHT)
    return "detVeh", vehicle


def _read_objects(objects: list[dict[str, Any]]) -> tuple[Columns, int]:
    """The columns in axes east and north, and the number of objects left out for want of size or heading."""
    sizes = [_received_size(item) for item in objects]
    whole = [
        (item["detObjCommon"], size)
        for item, size in zip(objects, sizes, strict=True)
        if size[0] > 0 and size[1] > 0 and item["detObjCommon"]["heading"] != _TURN
    ]
    n = len(whole)

    def values(name: str) -> FloatArray:
        return np.array([common[name] for common, _ in whole], dtype=np.float64).reshape(n)

    centers = [
        [common["pos"]["offsetX"], common["pos"]["offsetY"], common["pos"].get("offsetZ", 0)] for common, _ in whole
    ]
    yaw = wrap_angle(math.pi / 2 - values("heading") * _HEADING_UNIT)
    confidence, speed, offsets = values("objTypeCfd"), values("speed"), values("measurementTime") * _MILLISECOND
    labels = [_TYPES[kind][0] if (kind := common["objType"]) in _TYPES else "unknown" for common, _ in whole]
    speed = np.where(speed == _NO_SPEED, math.nan, speed * _SPEED_UNIT)
    boxes = Boxes(
        np.array(centers, dtype=np.float64).reshape(n, 3) * _DECIMETRE,
        np.array([size for _, size in whole], dtype=np.float64).reshape(n, 3),
        yaw,
        score=None if (confidence == _NO_CONFIDENCE).all() else confidence % _NO_CONFIDENCE / 100.0,
        track_id=values("objectID").astype(np.int64) if n else None,
        label=labels if any(label != "unknown" for label in labels) else None,
    )
    velocity = np.column_stack([speed * np.cos(yaw), speed * np.sin(yaw)])
    columns = Columns(
        boxes,
        velocity=None if np.isnan(velocity).all() else velocity,
        measurement_offset=offsets if offsets.any() else None,
    )
    return columns, len(objects) - n


def _received_size(item: dict[str, Any]) -> tuple[float, float, float]:
    """Length, width, height [m], 0 for unknown."""
    kind, value = item.get("detObjOptData", ("none", {}))
    if kind == "detVeh" and "size" in value:
        size = value["size"]
        return size["length"] * _CENTIMETRE, size["width"] * _CENTIMETRE, value.get("height", 0) * _HEIGHT_UNIT
    if kind == "detObst":
        size = value["obstSize"]
        return size["length"] * _DECIMETRE, size["width"] * _DECIMETRE, size.get("height", 0) * _DECIMETRE
    return 0.0, 0.0, 0.0


def _type_of(label: str) -> str:
    """The objType of a label."""
    return next((kind for kind, labels in _TYPES.items() if label.lower() in labels), "unknown")
