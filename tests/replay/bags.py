"""Bags with any messages, written by rosbags; messages are nested dicts."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from rosbags import rosbag1, rosbag2
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from cobevglue.recordings.message_definitions import DETECTIONS, LAYOUTS

DETECTION3DARRAY = "vision_msgs/msg/Detection3DArray"
POINTCLOUD2 = "sensor_msgs/msg/PointCloud2"
BYTES = "std_msgs/msg/UInt8MultiArray"
UDP = "udp_msgs/msg/UdpPacket"

Entry = tuple[str, str, float, Any]
"""Topic, type, time of receipt [s] and message."""


def store_of(definitions: Mapping[str, str], base: Stores = Stores.ROS2_HUMBLE) -> Any:
    """Known types, and those of these definitions."""
    store, types = get_typestore(base), {}
    for name, text in definitions.items():
        types.update(get_types_from_msg(text, name))
    store.register(types)
    return store


def write_bag(
    path: Path,
    entries: Iterable[Entry],
    *,
    sqlite: bool = False,
    definitions: Mapping[str, str] | None = None,
    with_definitions: bool = True,
    compressed: str = "none",
) -> Path:
    """A ROS 2 bag.

    Args:
        path: its folder.
        entries: the messages, in any order of receipt.
        sqlite: store it in SQLite in place of MCAP.
        definitions: of types that ROS 2 Humble has not.
        with_definitions: False for a bag in SQLite as ROS 2 Humble and older write it.
        compressed: as rosbags names it: none, file, message or storage.
    """
    store = store_of(LAYOUTS[0] if definitions is None else definitions)
    plugin = rosbag2.StoragePlugin.SQLITE3 if sqlite else rosbag2.StoragePlugin.MCAP
    writer = rosbag2.Writer(path, version=9, storage_plugin=plugin)
    writer.set_compression(rosbag2.CompressionMode[compressed.upper()], rosbag2.CompressionFormat.ZSTD)
    with writer:
        connections: dict[str, Any] = {}
        for topic, kind, received, message in entries:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            data = store.serialize_cdr(make(store, kind, message), kind)
            writer.write(connections[topic], round(1e9 * received), data)
    if not with_definitions:
        (file,) = path.glob("*.db3")
        with sqlite3.connect(file) as database:
            database.execute("DELETE FROM message_definitions")
        database.close()
    return path


def write_ros1_bag(path: Path, entries: Iterable[Entry], definitions: Mapping[str, str]) -> Path:
    """A ROS 1 bag."""
    store = store_of(definitions, Stores.ROS1_NOETIC)
    with rosbag1.Writer(path) as writer:
        connections: dict[str, Any] = {}
        for topic, kind, received, message in entries:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=store)
            data = store.serialize_ros1(make(store, kind, message), kind)
            writer.write(connections[topic], round(1e9 * received), data)
    return path


def make(store: Any, kind: str, message: Mapping[str, Any]) -> Any:
    """A message of this type from a nested dict; fields that are left out are 0, "" or empty."""
    values = {}
    for name, (node, detail) in store.fielddefs[kind][1]:
        values[name] = _value(store, node.name, detail, message.get(name))
    unknown = set(message) - set(values)
    assert not unknown, f"{kind} has no {unknown}"
    return store.types[kind](**values)


def _value(store: Any, node: str, detail: Any, given: Any) -> Any:
    if node == "BASE":
        return ("" if detail[0] == "string" else 0) if given is None else given
    if node == "NAME":
        return make(store, detail, given or {})
    (element, element_detail), length = detail
    if element.name == "BASE" and element_detail[0] != "string":
        kind = np.dtype(element_detail[0].replace("octet", "uint8"))
        return np.zeros(length or 0, kind) if given is None else np.asarray(given, kind)
    return [_value(store, element.name, element_detail, each) for each in given or ()]


def header(stamp: float, frame_id: str = "base_link") -> dict[str, Any]:
    """A header."""
    seconds, nanoseconds = divmod(round(1e9 * stamp), 10**9)
    return {"stamp": {"sec": seconds, "nanosec": nanoseconds}, "frame_id": frame_id}


def pose(x: float, y: float, yaw: float = 0.0) -> dict[str, Any]:
    """A pose in the plane."""
    orientation = {"z": float(np.sin(yaw / 2)), "w": float(np.cos(yaw / 2))}
    return {"position": {"x": x, "y": y}, "orientation": orientation}


def detection(x: float, y: float, identity: str = "", label: str = "car", score: float = 0.9) -> dict[str, Any]:
    """A car, as vision_msgs has it since Humble."""
    return {
        "results": [{"hypothesis": {"class_id": label, "score": score}}],
        "bbox": {"center": pose(x, y), "size": {"x": 4.5, "y": 1.9, "z": 1.5}},
        "id": identity,
    }


def detections(stamp: float, *objects: dict[str, Any], frame_id: str = "base_link") -> dict[str, Any]:
    """A Detection3DArray."""
    return {"header": header(stamp, frame_id), "detections": list(objects)}


__all__ = [
    "BYTES",
    "DETECTION3DARRAY",
    "DETECTIONS",
    "POINTCLOUD2",
    "UDP",
    "Entry",
    "detection",
    "detections",
    "header",
    "make",
    "pose",
    "store_of",
    "write_bag",
    "write_ros1_bag",
]
