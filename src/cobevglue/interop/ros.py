"""ROS messages to `Boxes` and point clouds: what `cobevglue replay` reads, and what a ROS node can pass on.

Messages are recognised by their fields, so those of rclpy and those of a library that reads bags are the same here:

- `vision_msgs/Detection3DArray`: all layouts, that is `results[].hypothesis.class_id` (since ROS 2 Humble) or
  `results[].id`; the identity in `id` or `tracking_id`.
- `autoware_perception_msgs` and `autoware_auto_perception_msgs`: `DetectedObjects`, `TrackedObjects`.
- `sensor_msgs/PointCloud2`.

Boxes and points stay in the frame of the message's header, which should be the agent's own (REP-103: x forward, y left,
z up). Covariances are not read: BEVGlue has one noise model for all boxes.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from cobevglue.boxes import Boxes
from cobevglue.datasets.poses import upright_yaw
from cobevglue.typing import FloatArray

__all__ = ["RosObjects", "boxes_from_ros", "points_from_ros", "stamp_from_ros"]

_LABELS = ("unknown", "car", "truck", "bus", "trailer", "motorcycle", "bicycle", "pedestrian", "animal", "hazard")
"""Names of the labels 0, 1, … of Autoware's ObjectClassification."""
_BOX, _CYLINDER, _POLYGON = 0, 1, 2
"""Autoware's shape types."""
_UNIT_WITHIN = 0.01
"""A quaternion whose norm is farther from 1 is no orientation."""
_POINT_FIELD_TYPES = {1: "i1", 2: "u1", 3: "i2", 4: "u2", 5: "i4", 6: "u4", 7: "f4", 8: "f8"}
"""NumPy types of PointField's `datatype`."""
_INTENSITIES = ("intensity", "i", "intensities", "reflectivity")


@dataclass(frozen=True, slots=True, eq=False)
class RosObjects:
    """The objects of one message.

    Attributes:
        boxes: N boxes in the frame of the message; with scores and labels if all objects have them, with track ids if
            all have different ones.
        without_size: number of objects left out, since a length or width of 0 means that it is unknown.
    """

    boxes: Boxes
    without_size: int = 0


@dataclass(frozen=True, slots=True)
class _Object:
    pose: Any
    size: tuple[float, float, float]
    score: float | None
    identity: str
    label: str | None
    offset: tuple[float, float] = (0.0, 0.0)
    """Of the middle of the box from the pose, along its own axes [m]."""


def boxes_from_ros(message: Any, numbers_of_ids: dict[str, int] | None = None) -> RosObjects:
    """Convert a message with objects.

    Args:
        message: Detection3DArray, DetectedObjects or TrackedObjects.
        numbers_of_ids: the track id of each identity (text or UUID). Unknown ones get the next number and are added, so
            use one dict for all messages of an agent. None for boxes without track ids.

    Raises:
        ValueError: not such a message, or a field with a bad value; names field and row.
    """
    if hasattr(message, "detections"):
        field, found = "detections", [_detection(item) for item in message.detections]
    elif hasattr(message, "objects"):
        field, found = "objects", [_autoware_object(item) for item in message.objects]
    else:
        raise ValueError(f"{type(message).__name__} has neither detections nor objects")
    known = np.array([item.size[0] != 0.0 and item.size[1] != 0.0 for item in found], dtype=bool)
    try:
        yaw = _yaws([item.pose.orientation for item in found])
        c, s = np.cos(yaw), np.sin(yaw)
        along, across = np.array([item.offset for item in found], dtype=np.float64).reshape(-1, 2).T
        center = np.array([(p.x, p.y, p.z) for p in (item.pose.position for item in found)]).reshape(-1, 3)
        center[:, :2] += np.column_stack([c * along - s * across, s * along + c * across])
        boxes = Boxes(
            center,
            [item.size if has_size else (1.0, 1.0, 1.0) for item, has_size in zip(found, known, strict=True)],
            yaw,
            score=_all_or_none(item.score for item in found),
            track_id=None if numbers_of_ids is None else _track_ids([item.identity for item in found], numbers_of_ids),
            label=_all_or_none(item.label for item in found),
        )
    except ValueError as error:
        raise ValueError(f"{field}: {error}") from None
    return RosObjects(boxes[known], int((~known).sum()))


def points_from_ros(message: Any) -> FloatArray:
    """(N, 4) x, y, z [m] and intensity (as stored, 0 if there is none) of a PointCloud2; invalid points are kept.

    Raises:
        ValueError: not a PointCloud2 with x, y and z, or one with too few bytes.
    """
    fields = {field.name: field for field in getattr(message, "fields", ())}
    missing = [name for name in "xyz" if name not in fields]
    if missing:
        raise ValueError(f"fields: there is no {' and no '.join(missing)}, only {', '.join(fields) or 'none'}")
    width, height, step = int(message.width), int(message.height), int(message.point_step)
    data = np.frombuffer(bytes(message.data), np.uint8)
    row_step = int(message.row_step) or width * step
    if len(data) < height * row_step or row_step < width * step:
        raise ValueError(f"data: {len(data)} bytes are too few for {height} x {width} points of {step} bytes")
    rows = data[: height * row_step].reshape(height, row_step)[:, : width * step].reshape(-1, step)
    order = ">" if message.is_bigendian else "<"
    names = [*"xyz", *[name for name in _INTENSITIES if name in fields][:1]]
    points = np.zeros((len(rows), 4))
    for column, name in enumerate(names):
        field = fields[name]
        if field.datatype not in _POINT_FIELD_TYPES:
            raise ValueError(f"fields: {name}: unknown datatype {field.datatype}")
        kind = np.dtype(order + _POINT_FIELD_TYPES[field.datatype])
        if field.offset + kind.itemsize > step:
            raise ValueError(f"fields: {name}: offset {field.offset} is outside of a point of {step} bytes")
        values = np.ascontiguousarray(rows[:, field.offset : field.offset + kind.itemsize])
        points[:, column] = values.view(kind)[:, 0]
    return points


def stamp_from_ros(message: Any) -> float:
    """Time stamp of the message's header [s]; 0 is what ROS has for "not set"."""
    stamp = message.header.stamp
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def _detection(item: Any) -> _Object:
    """An object of vision_msgs: the class with the highest score."""
    hypotheses = [getattr(result, "hypothesis", result) for result in item.results]
    best = max(hypotheses, key=lambda hypothesis: hypothesis.score, default=None)
    label = None if best is None else str(getattr(best, "class_id", getattr(best, "id", "")))
    size = item.bbox.size
    identity = getattr(item, "id", "") or getattr(item, "tracking_id", "")
    score = None if best is None else float(best.score)
    return _Object(item.bbox.center, (size.x, size.y, size.z), score, str(identity), label)


def _autoware_object(item: Any) -> _Object:
    """An object of Autoware: the class with the highest probability; a polygon becomes the box around it."""
    best = max(item.classification, key=lambda each: each.probability, default=None)
    number = 0 if best is None else int(getattr(best, "label", getattr(best, "classification", 0)))
    label = _LABELS[number] if number < len(_LABELS) else str(number)
    shape = item.shape[0] if isinstance(item.shape, Sequence) else item.shape
    dimensions = shape.dimensions
    size, offset = (dimensions.x, dimensions.y, dimensions.z), (0.0, 0.0)
    if shape.type == _CYLINDER:
        size = (dimensions.x, dimensions.x, dimensions.z)  # the diameter
    elif shape.type == _POLYGON and len(shape.footprint.points):
        corners = np.array([(point.x, point.y) for point in shape.footprint.points], dtype=np.float64)
        low, high = corners.min(axis=0), corners.max(axis=0)
        size, offset = (*(high - low).tolist(), dimensions.z), tuple(((low + high) / 2.0).tolist())
    pose = item.kinematics.pose_with_covariance.pose
    return _Object(pose, size, float(item.existence_probability), _identity(item), label, offset)


def _identity(item: Any) -> str:
    """The UUID of a tracked object as text; "" for a detected one."""
    identity = getattr(item, "object_id", None)
    uuid = getattr(identity, "uuid", None)
    return "" if uuid is None else bytes(bytearray(uuid)).hex()


def _yaws(orientations: list[Any]) -> FloatArray:
    """(N,) yaw of unit quaternions [rad]; roll and pitch are dropped."""
    if not orientations:
        return np.zeros(0)
    values = np.array([(q.x, q.y, q.z, q.w) for q in orientations], dtype=np.float64)
    bad = ~(np.abs(np.linalg.norm(values, axis=1) - 1.0) <= _UNIT_WITHIN)
    if bad.any():
        row = int(bad.argmax())
        raise ValueError(f"row {row}: orientation must be a unit quaternion, got x, y, z, w = {values[row].tolist()}")
    return upright_yaw(Rotation.from_quat(values).as_matrix())


def _all_or_none(values: Iterable[Any]) -> list[Any] | None:
    """The values, if there are any and none of them is None."""
    listed = list(values)
    return listed if listed and all(value is not None for value in listed) else None


def _track_ids(identities: list[str], numbers: dict[str, int]) -> list[int] | None:
    """Numbers of the identities, if all are there and different."""
    if not identities or "" in identities or len(set(identities)) < len(identities):
        return None
    return [numbers.setdefault(identity, len(numbers)) for identity in identities]
