"""Writing object lists as a ROS 2 bag: a folder with an MCAP file, with topics of `vision_msgs/Detection3DArray`."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.recordings.message_definitions import DETECTIONS
from cobevglue.typing import FloatArray

__all__ = ["DetectionBag", "new_detection_bag"]

_TYPE = "vision_msgs/msg/Detection3DArray"


class DetectionBag:
    """A bag that is being written; see `new_detection_bag`."""

    def __init__(self, writer: Any, store: Any) -> None:
        self._writer, self._store = writer, store
        self._connections: dict[str, Any] = {}

    def write(self, topic: str, received: float, stamp: float, frame_id: str, boxes: Boxes) -> None:
        """Write an object list.

        Args:
            topic: for example `/car1/objects`.
            received: time at which the recorder received it [s].
            stamp: time at which the objects were seen, for the header [s].
            frame_id: name of the frame of the boxes.
            boxes: N boxes; the identity in a message is the track id, "" where there is none.
        """
        if topic not in self._connections:
            self._connections[topic] = self._writer.add_connection(topic, _TYPE, typestore=self._store)
        message = self._message(stamp, frame_id, boxes)
        self._writer.write(self._connections[topic], _nanoseconds(received), self._store.serialize_cdr(message, _TYPE))

    def _message(self, stamp: float, frame_id: str, boxes: Boxes) -> Any:
        seconds, nanoseconds = divmod(_nanoseconds(stamp), 10**9)
        header = self._make(
            "std_msgs", "Header", self._make("builtin_interfaces", "Time", seconds, nanoseconds), frame_id
        )
        detections = []
        for row in range(len(boxes)):
            pose = self._pose(boxes.center[row], float(boxes.yaw[row]))
            size = self._make("geometry_msgs", "Vector3", *boxes.size[row].tolist())
            label = "" if boxes.label is None else str(boxes.label[row])
            score = 1.0 if boxes.score is None else float(boxes.score[row])
            hypothesis = self._make(
                "vision_msgs",
                "ObjectHypothesisWithPose",
                self._make("vision_msgs", "ObjectHypothesis", label, score),
                self._make("geometry_msgs", "PoseWithCovariance", pose, np.zeros(36)),
            )
            box = self._make("vision_msgs", "BoundingBox3D", pose, size)
            identity = "" if boxes.track_id is None else str(boxes.track_id[row])
            detections.append(self._make("vision_msgs", "Detection3D", header, [hypothesis], box, identity))
        return self._make("vision_msgs", "Detection3DArray", header, detections)

    def _pose(self, center: FloatArray, yaw: float) -> Any:
        position = self._make("geometry_msgs", "Point", *center.tolist())
        orientation = self._make("geometry_msgs", "Quaternion", 0.0, 0.0, math.sin(yaw / 2.0), math.cos(yaw / 2.0))
        return self._make("geometry_msgs", "Pose", position, orientation)

    def _make(self, package: str, name: str, *values: Any) -> Any:
        return self._store.types[f"{package}/msg/{name}"](*values)


@contextmanager
def new_detection_bag(folder: str | Path) -> Iterator[DetectionBag]:
    """Write a bag: `metadata.yaml` and an MCAP file of the folder's name, complete when the block ends.

    Args:
        folder: of the bag; must not exist.

    Raises:
        FileExistsError: the folder exists.
        OSError: it cannot be written.
        ModuleNotFoundError: rosbags is not installed.
    """
    try:
        from rosbags import rosbag2
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore
    except ImportError as error:
        raise ModuleNotFoundError(
            f"recordings need rosbags: pip install 'cobevglue[ros]' ({error})", name="rosbags"
        ) from None
    if Path(folder).exists():
        raise FileExistsError(f"{folder}: exists already")
    store, types = get_typestore(Stores.ROS2_HUMBLE), {}
    for name, definition in DETECTIONS.items():
        types.update(get_types_from_msg(definition, name))
    store.register(types)
    writer = rosbag2.Writer(folder, version=9, storage_plugin=rosbag2.StoragePlugin.MCAP)
    writer.set_compression(rosbag2.CompressionMode.STORAGE, rosbag2.CompressionFormat.ZSTD)
    with writer:
        yield DetectionBag(writer, store)


def _nanoseconds(seconds: float) -> int:
    return round(1e9 * seconds)
