"""Conversion between boxes with further columns and the `PerceivedObject`s of a CPM."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.messages.columns import Columns
from cobevglue.messages.fields import rounded, whole_units
from cobevglue.messages.object_message import MessageError
from cobevglue.se2 import SE2, wrap_angle
from cobevglue.typing import FloatArray, IntArray

__all__ = ["objects_from_columns", "read_objects"]

_CENTIMETRE, _DECIMETRE, _TENTH_OF_DEGREE, _MILLISECOND = 0.01, 0.1, math.radians(0.1), 0.001
_MAX_COORDINATE, _MAX_SPEED, _MAX_SIZE, _MAX_AGE, _MAX_OFFSET = 131070, 16381, 255, 1500, 2046
_NO_COORDINATE_CONFIDENCE, _NO_ANGLE_CONFIDENCE, _NO_SPEED_CONFIDENCE, _NO_SIZE_CONFIDENCE = 4096, 127, 127, 32
_NO_CLASS_CONFIDENCE, _NO_SIZE, _NO_ANGLE, _NO_VELOCITY, _NO_SPEED = 101, 256, 3601, 16383, 16383
_95_PERCENT = 1.96  # standard deviations on either side of the mean

_VEHICLES = {
    "vehicle": 0,
    "car": 5,
    "bus": 6,
    "van": 7,
    "truck": 8,
    "trailer": 9,
    "special vehicle": 10,
    "tram": 11,
    "agricultural": 14,
}
"""vehicleSubClass by label. The standard classifies a van as a light truck."""
_ROAD_USERS = {
    "pedestrian": ("pedestrian", "ordinary-pedestrian"),
    "cyclist": ("bicyclistAndLightVruVehicle", "bicyclist"),
    "motorcycle": ("motorcyclist", "motorcycle"),
    "animal": ("animal", "unavailable"),
}
"""vruSubClass by label."""
_SYNONYMS = {"bicycle": "cyclist", "bicyclist": "cyclist", "motorcyclist": "motorcycle", "person": "pedestrian"}


def objects_from_columns(columns: Columns, heading: float) -> list[dict[str, Any]]:
    """Convert boxes and columns to `PerceivedObject`s, in the form that asn1tools encodes.

    Args:
        columns: N objects with track ids 0 to 65535, in the sender's frame.
        heading: heading of the sender's x axis in the axes of the message [rad].

    Raises:
        MessageError: a value is out of range; the error names field and row.
    """
    boxes = columns.boxes.transform(SE2(0.0, 0.0, heading))
    centers = whole_units("center (east, north, up)", boxes.center, _CENTIMETRE, _MAX_COORDINATE, "a CPM")
    sizes = np.clip(rounded(boxes.size / _DECIMETRE), 1, _MAX_SIZE)
    angles = rounded(boxes.yaw / _TENTH_OF_DEGREE) % 3600
    coordinate_confidence = _confidences(columns.position_std, len(boxes), _CENTIMETRE, 4095, _NO_COORDINATE_CONFIDENCE)
    angle_confidence = _confidences(columns.yaw_std, len(boxes), _TENTH_OF_DEGREE, 126, _NO_ANGLE_CONFIDENCE)
    offsets = np.zeros(len(boxes), np.int64)
    if columns.measurement_offset is not None:
        offsets = whole_units("measurement_offset", columns.measurement_offset, _MILLISECOND, _MAX_OFFSET, "a CPM")
    assert boxes.track_id is not None
    objects = []
    for row, (center, size) in enumerate(zip(centers.tolist(), sizes.tolist(), strict=True)):
        confidence = int(coordinate_confidence[row])
        item: dict[str, Any] = {
            "objectId": int(boxes.track_id[row]),
            "measurementDeltaTime": int(offsets[row]),
            "position": {
                f"{axis}Coordinate": {
                    "value": value,
                    "confidence": _NO_COORDINATE_CONFIDENCE if axis == "z" else confidence,
                }
                for axis, value in zip("xyz", center, strict=True)
            },
            "angles": {"zAngle": {"value": int(angles[row]), "confidence": int(angle_confidence[row])}},
            "objectDimensionX": {"value": size[0], "confidence": _NO_SIZE_CONFIDENCE},
            "objectDimensionY": {"value": size[1], "confidence": _NO_SIZE_CONFIDENCE},
        }
        if boxes.size[row, 2] > 0:
            item["objectDimensionZ"] = {"value": size[2], "confidence": _NO_SIZE_CONFIDENCE}
        if boxes.label is not None:
            item["classification"] = [{"objectClass": _class_of(boxes.label[row]), "confidence": _NO_CLASS_CONFIDENCE}]
        objects.append(item)
    _add_velocities(objects, columns.velocity, heading)
    _add_ages(objects, columns.age)
    _add_scores(objects, boxes.score)
    return objects


def read_objects(objects: list[dict[str, Any]], heading: float) -> tuple[Columns, int]:
    """Convert decoded `PerceivedObject`s to boxes and columns in the sender's frame.

    Args:
        objects: `PerceivedObject`s as decoded by asn1tools.
        heading: heading of the sender's x axis in the axes of the message [rad].

    Returns:
        The columns, and the number of objects omitted because length, width or angle is missing.

    Raises:
        ValueError: invalid boxes, such as two objects with one id.
    """
    whole = [item for item in objects if _is_box(item)]
    n = len(whole)
    # multiplying whole units, so that encoding again gives the same numbers
    centers = np.array([_center(item) for item in whole]).reshape(n, 3) * _CENTIMETRE
    sizes = np.array([[_size(item, axis) for axis in "XYZ"] for item in whole]).reshape(n, 3) * _DECIMETRE
    angles = np.array([item["angles"]["zAngle"]["value"] for item in whole]).reshape(n) * _TENTH_OF_DEGREE
    ids = [item.get("objectId") for item in whole]
    qualities = [item.get("objectPerceptionQuality") for item in whole]
    sender_SE2_axes = SE2(0.0, 0.0, -heading)
    boxes = Boxes(
        center=sender_SE2_axes.apply(centers),
        size=sizes,
        yaw=wrap_angle(angles - heading),
        score=None if all(q is None for q in qualities) else [(q or 0) / 15.0 for q in qualities],
        track_id=None if None in ids or not ids else ids,
        label=[_label(item) for item in whole] if any("classification" in item for item in whole) else None,
    )
    velocity = np.array([_velocity(item) for item in whole]).reshape(n, 2)
    offsets = np.array([item["measurementDeltaTime"] for item in whole]).reshape(n) * _MILLISECOND
    columns = Columns(
        boxes,
        _if_any(velocity @ sender_SE2_axes.rotation.T),
        _if_any(np.array([item.get("objectAge", math.nan) for item in whole]).reshape(n) * _MILLISECOND),
        offsets if offsets.any() else None,
        _if_any(_standard_deviations([_coordinate_confidence(item) for item in whole], _CENTIMETRE, 4095)),
        _if_any(
            _standard_deviations([item["angles"]["zAngle"]["confidence"] for item in whole], _TENTH_OF_DEGREE, 126)
        ),
    )
    return columns, len(objects) - n


def _add_velocities(objects: list[dict[str, Any]], velocity: FloatArray | None, heading: float) -> None:
    if velocity is None:
        return
    turned = velocity @ SE2(0.0, 0.0, heading).rotation.T
    known = ~np.isnan(turned[:, 0] + turned[:, 1])
    units = whole_units("velocity", np.where(known[:, None], turned, 0.0), _CENTIMETRE, _MAX_SPEED, "a CPM")
    for item, (x, y), is_known in zip(objects, units.tolist(), known.tolist(), strict=True):
        if is_known:
            item["velocity"] = (
                "cartesianVelocity",
                {
                    "xVelocity": {"value": x, "confidence": _NO_SPEED_CONFIDENCE},
                    "yVelocity": {"value": y, "confidence": _NO_SPEED_CONFIDENCE},
                },
            )


def _add_ages(objects: list[dict[str, Any]], age: FloatArray | None) -> None:
    if age is None:
        return
    for row, (item, value) in enumerate(zip(objects, age.tolist(), strict=True)):
        if value < 0:
            raise MessageError(f"age: row {row} is {value}, it must be >= 0")
        if not math.isnan(value):
            item["objectAge"] = round(min(value / _MILLISECOND, _MAX_AGE))


def _add_scores(objects: list[dict[str, Any]], score: FloatArray | None) -> None:
    if score is None:
        return
    outside = (score < 0) | (score > 1)
    if outside.any():
        row = int(outside.argmax())
        raise MessageError(f"score: row {row} is {score[row]}, a CPM holds scores from 0 to 1 only")
    for item, value in zip(objects, score.tolist(), strict=True):
        item["objectPerceptionQuality"] = round(15.0 * value)


def _confidences(std: FloatArray | None, n: int, unit: float, out_of_range: int, unavailable: int) -> IntArray:
    """Return half widths of 95 % intervals, rounded up to whole units except for an excess below a millionth."""
    if std is None:
        return np.full(n, unavailable)
    if (std < 0).any():
        raise MessageError(f"standard deviations must be >= 0, row {int((std < 0).argmax())} is {std.min()}")
    half_width = np.ceil(np.nan_to_num(_95_PERCENT * std / unit, nan=0.0, posinf=out_of_range) - 1e-6)
    return np.where(np.isnan(std), unavailable, np.clip(half_width, 1, out_of_range)).astype(np.int64)


def _standard_deviations(confidences: list[int], unit: float, out_of_range: int) -> FloatArray:
    values = np.array(confidences, dtype=np.float64)
    std: FloatArray = values * unit / _95_PERCENT
    std[values == out_of_range] = math.inf
    std[values > out_of_range] = math.nan
    return std


def _if_any(values: FloatArray) -> FloatArray | None:
    """Return the column, or None if all its values are unknown."""
    return values if not np.isnan(values).all() else None


def _is_box(item: dict[str, Any]) -> bool:
    """Return whether length, width and angle are known and the position is within the standard's range."""
    inside = all(abs(value) <= _MAX_COORDINATE for value in _center(item))
    angle: int = item.get("angles", {}).get("zAngle", {}).get("value", _NO_ANGLE)
    return inside and angle != _NO_ANGLE and _size(item, "X") > 0 and _size(item, "Y") > 0


def _center(item: dict[str, Any]) -> list[int]:
    return [item["position"].get(f"{axis}Coordinate", {}).get("value", 0) for axis in "xyz"]


def _coordinate_confidence(item: dict[str, Any]) -> int:
    x, y = item["position"]["xCoordinate"]["confidence"], item["position"]["yCoordinate"]["confidence"]
    return max(int(x), int(y))


def _size(item: dict[str, Any], axis: str) -> int:
    """Return a dimension in decimetres, 0 for unknown."""
    value: int = item.get(f"objectDimension{axis}", {}).get("value", _NO_SIZE)
    return 0 if value == _NO_SIZE else value


def _velocity(item: dict[str, Any]) -> tuple[float, float]:
    """Return the velocity along the axes of the message [m/s], NaN where unknown."""
    kind, value = item.get("velocity", ("none", {}))
    if kind == "cartesianVelocity":
        x, y = value["xVelocity"]["value"], value["yVelocity"]["value"]
        if _NO_VELOCITY not in (x, y):
            return x * _CENTIMETRE, y * _CENTIMETRE
    elif kind == "polarVelocity":
        speed, angle = value["velocityMagnitude"]["speedValue"], value["velocityDirection"]["value"]
        if speed != _NO_SPEED and angle != _NO_ANGLE:
            return (
                speed * _CENTIMETRE * math.cos(angle * _TENTH_OF_DEGREE),
                speed * _CENTIMETRE * math.sin(angle * _TENTH_OF_DEGREE),
            )
    return math.nan, math.nan


def _class_of(label: str) -> tuple[str, Any]:
    """Return the objectClass of a label, or "other, unknown" for a label that the standard does not define."""
    name = _SYNONYMS.get(label.lower(), label.lower())
    if name in _VEHICLES:
        return "vehicleSubClass", _VEHICLES[name]
    if name in _ROAD_USERS:
        return "vruSubClass", _ROAD_USERS[name]
    return "otherSubClass", 0


def _label(item: dict[str, Any]) -> str:
    """Return the label of the class with the highest confidence, or "unknown" if no label corresponds to it."""
    classes = item.get("classification", [])
    if not classes:
        return "unknown"
    best = max(classes, key=lambda entry: entry["confidence"] % _NO_CLASS_CONFIDENCE)
    kind, value = best["objectClass"]
    if kind == "vehicleSubClass":
        return next((label for label, number in _VEHICLES.items() if number == value), "unknown")
    if kind == "vruSubClass":
        return next((label for label, (profile, _) in _ROAD_USERS.items() if profile == value[0]), "unknown")
    return "unknown"
