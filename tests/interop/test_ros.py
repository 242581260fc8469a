"""ROS messages by hand: each layout, identities, sizes, orientations, clouds with any fields, and bad values."""

from __future__ import annotations

import math
from types import SimpleNamespace as Message
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cobevglue.interop.ros import boxes_from_ros, points_from_ros, stamp_from_ros


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0, rotation: Rotation | None = None) -> Message:
    quaternion = (rotation or Rotation.identity()).as_quat().tolist()
    return Message(position=Message(x=x, y=y, z=z), orientation=Message(**dict(zip("xyzw", quaternion, strict=True))))


def size(x: float = 4.5, y: float = 1.9, z: float = 1.5) -> Message:
    return Message(x=x, y=y, z=z)


def detection(**fields: Any) -> Message:
    box = Message(center=fields.pop("center", pose()), size=fields.pop("size", size()))
    return Message(**{"results": [], "bbox": box, "id": "", **fields})


def detections(*items: Message) -> Message:
    return Message(detections=list(items))


def hypothesis(label: str, score: float) -> Message:
    return Message(hypothesis=Message(class_id=label, score=score))


def autoware(shape: Any, at: Message | None = None, **fields: Any) -> Message:
    kinematics = Message(pose_with_covariance=Message(pose=at or pose()))
    whole = {"classification": [], "existence_probability": 0.5, "shape": shape, "kinematics": kinematics, **fields}
    return Message(objects=[Message(**whole)])


def polygon(*corners: tuple[float, float], dimensions: Message | None = None, kind: int = 2) -> Message:
    points = [Message(x=x, y=y, z=0.0) for x, y in corners]
    return Message(type=kind, footprint=Message(points=points), dimensions=dimensions or size(0.0, 0.0, 1.5))


def test_class_with_the_best_score_is_taken() -> None:
    found = boxes_from_ros(detections(detection(results=[hypothesis("van", 0.3), hypothesis("car", 0.6)]))).boxes
    assert found.label is not None
    assert found.score is not None
    assert (found.label.tolist(), found.score.tolist()) == (["car"], [0.6])


def test_scores_are_of_all_objects_or_none() -> None:
    found = boxes_from_ros(detections(detection(results=[hypothesis("car", 0.6)]), detection())).boxes
    assert found.score is None
    assert found.label is None


@pytest.mark.parametrize(
    ("fields", "identity"),
    [({"id": "a"}, "a"), ({"id": "", "tracking_id": "b"}, "b"), ({"tracking_id": "c", "is_tracking": True}, "c")],
)
def test_identities_of_all_layouts(fields: dict[str, Any], identity: str) -> None:
    numbers: dict[str, int] = {"other": 0}
    item = detection(**fields)
    if "id" not in fields:
        del item.id
    assert boxes_from_ros(detections(item), numbers).boxes.track_id is not None
    assert numbers == {"other": 0, identity: 1}


@pytest.mark.parametrize("identities", [("", ""), ("a", ""), ("a", "a")], ids=["none", "some", "doubled"])
def test_incomplete_identities_are_not_used(identities: tuple[str, str]) -> None:
    message = detections(*(detection(id=identity) for identity in identities))
    assert boxes_from_ros(message, {}).boxes.track_id is None
    assert boxes_from_ros(message).boxes.track_id is None


def test_objects_without_size_are_counted() -> None:
    message = detections(detection(id="a", size=size(0.0, 0.0)), detection(id="b", center=pose(7.0)))
    found = boxes_from_ros(message, {})
    assert found.without_size == 1
    assert found.boxes.center[:, 0].tolist() == [7.0]


@given(st.floats(-3.1, 3.1), st.floats(-0.3, 0.3), st.floats(-0.3, 0.3))
def test_yaw_is_that_of_the_quaternion(yaw: float, pitch: float, roll: float) -> None:
    rotation = Rotation.from_euler("ZYX", [yaw, pitch, roll])
    found = boxes_from_ros(detections(detection(center=pose(rotation=rotation)))).boxes
    assert found.yaw[0] == pytest.approx(yaw, abs=1e-9)


BAD = math.nan


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"center": Message(position=size(), orientation=Message(x=0.0, y=0.0, z=0.0, w=0.0))}, "row 1: orientation"),
        ({"center": Message(position=size(), orientation=Message(x=0.0, y=0.0, z=0.0, w=2.0))}, "row 1: orientation"),
        ({"center": Message(position=size(), orientation=Message(x=BAD, y=0.0, z=0.0, w=1.0))}, "row 1: orientation"),
        ({"center": pose(x=BAD)}, "center: row 1 is not finite"),
        ({"size": size(x=BAD)}, "size: row 1 is not finite"),
        ({"size": size(x=-1.0)}, "size: row 1"),
        ({"results": [hypothesis("car", BAD)]}, "score: row 1 is not finite"),
    ],
    ids=["zero quaternion", "not of length 1", "NaN in it", "position", "size", "negative size", "score"],
)
def test_bad_values_are_named(change: dict[str, Any], message: str) -> None:
    good = detection(results=[hypothesis("car", 0.5)])
    bad = detection(**{"results": [hypothesis("car", 0.5)], **change})
    with pytest.raises(ValueError, match=f"detections: {message}"):
        boxes_from_ros(detections(good, bad))


def test_other_messages_are_refused() -> None:
    with pytest.raises(ValueError, match="neither detections nor objects"):
        boxes_from_ros(Message(text="hello"))


def test_cylinder_is_as_wide_as_long() -> None:
    cylinder = polygon(dimensions=size(0.8, 0.0, 1.7), kind=1)
    assert boxes_from_ros(autoware(cylinder)).boxes.size.tolist() == [[0.8, 0.8, 1.7]]


def test_polygon_becomes_the_box_around_it() -> None:
    # 4 m long and 2 m wide, its middle 1 m ahead of the pose, which looks to the left.
    shape = polygon((3.0, 1.0), (-1.0, 1.0), (-1.0, -1.0), (3.0, 0.0))
    found = boxes_from_ros(autoware(shape, pose(10.0, 0.0, rotation=Rotation.from_rotvec([0, 0, math.pi / 2])))).boxes
    np.testing.assert_allclose(found.bev, [[10.0, 1.0, 4.0, 2.0, math.pi / 2]], atol=1e-12)


def test_list_of_shapes_and_unknown_label() -> None:
    shape = Message(type=0, footprint=Message(points=[]), dimensions=size())
    classes = [Message(label=99, probability=1.0)]
    found = boxes_from_ros(autoware([shape], classification=classes)).boxes
    assert found.label is not None
    assert found.label.tolist() == ["99"]


def test_stamp_in_seconds() -> None:
    assert stamp_from_ros(Message(header=Message(stamp=Message(sec=12, nanosec=500_000_000)))) == 12.5


TYPES = {"i1": 1, "u1": 2, "i2": 3, "u2": 4, "i4": 5, "u4": 6, "f4": 7, "f8": 8}


def cloud(array: np.ndarray, *, rows: int = 1, row_padding: int = 0) -> Message:
    """A PointCloud2 of a structured array, of which NumPy lays out the bytes."""
    assert array.dtype.fields is not None
    fields = [
        Message(name=name, offset=offset, datatype=TYPES[kind.str[1:]], count=1)
        for name, (kind, offset, *_) in array.dtype.fields.items()
    ]
    width, step = len(array) // rows, array.dtype.itemsize
    data = b"".join(array[row * width : (row + 1) * width].tobytes() + bytes(row_padding) for row in range(rows))
    return Message(
        fields=fields,
        width=width,
        height=rows,
        point_step=step,
        row_step=width * step + row_padding,
        data=data,
        is_bigendian=array.dtype["x"].str[0] == ">",
    )


@pytest.mark.parametrize("order", ["<", ">"])
@pytest.mark.parametrize(
    "kinds",
    [
        {"x": "f4", "y": "f4", "z": "f4", "intensity": "f4"},
        {"x": "f8", "y": "f8", "z": "f8"},
        {"ring": "u2", "x": "f4", "y": "f4", "z": "f4", "reflectivity": "u1", "t": "u4"},
        {"z": "f4", "y": "f4", "x": "f4", "i": "i2"},
    ],
    ids=["usual", "doubles", "ring and time", "another order"],
)
def test_clouds_of_any_layout(kinds: dict[str, str], order: str) -> None:
    dtype = np.dtype([(name, order + kind if kind != "u1" else kind) for name, kind in kinds.items()])
    array = np.zeros(6, dtype)
    for column, name in enumerate(kinds):
        array[name] = np.arange(6) * (column + 1)
    points = points_from_ros(cloud(array, rows=2, row_padding=3))
    brightness = next((name for name in ("intensity", "reflectivity", "i") if name in kinds), None)
    for column, name in enumerate("xyz"):
        np.testing.assert_array_equal(points[:, column], array[name])
    np.testing.assert_array_equal(points[:, 3], 0.0 if brightness is None else array[brightness])


def test_bad_clouds_are_named() -> None:
    array = np.zeros(4, np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4")]))
    short = cloud(array)
    short.data = short.data[:-1]
    with pytest.raises(ValueError, match="data: 47 bytes are too few for 1 x 4 points"):
        points_from_ros(short)
    flat = cloud(array)
    flat.fields = flat.fields[:2]
    with pytest.raises(ValueError, match="fields: there is no z, only x, y"):
        points_from_ros(flat)
    unknown = cloud(array)
    unknown.fields[2].datatype = 42
    with pytest.raises(ValueError, match="fields: z: unknown datatype 42"):
        points_from_ros(unknown)
    outside = cloud(array)
    outside.fields[2].offset = 10
    with pytest.raises(ValueError, match="fields: z: offset 10 is outside"):
        points_from_ros(outside)
