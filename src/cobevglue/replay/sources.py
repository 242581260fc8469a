"""From the messages of a topic to object lists: objects, point clouds through the detector, or messages of others."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.datasets.poses import transform_boxes
from cobevglue.interop.ros import boxes_from_ros, points_from_ros, stamp_from_ros
from cobevglue.messages import MessageError, ObjectMessage, decode
from cobevglue.recordings import Topic
from cobevglue.replay.topics import CLOUDS, MESSAGES
from cobevglue.replay.transforms import Transforms

if TYPE_CHECKING:
    from cobevglue.perception import Perception, PointPillars

__all__ = ["Content", "Source", "is_elsewhere", "make_source"]

_FIXED_FRAMES = frozenset({"map", "odom", "world", "earth", "utm"})
_VEHICLE = "base_link"
"""Frame of a vehicle, by the convention of ROS (REP-105)."""
_FARTHEST, _LARGEST = 10_000.0, 1_000.0
"""Of the objects that an agent can see: distance and size [m]; beyond, they are not in its frame, or damaged."""
_CPM_PORT = (2009).to_bytes(2, "big")
"""Destination port of CPMs in the header of ETSI's basic transport protocol, which precedes them in packets."""
_SDSM = b"\x00\x29"  # a MessageFrame with the id of an SDSM
_OBJECT_MESSAGE = b"CBVG"


@dataclass(frozen=True, slots=True, eq=False)
class Content:
    """What a message says.

    Attributes:
        boxes: in the agent's frame; with track ids only if the sender gives them.
        body: one-row box of the agent's own vehicle, or None.
        without_size: number of objects left out, since their size is unknown.
        new_identities: the track ids have nothing to do with those of earlier messages.
    """

    boxes: Boxes
    body: Boxes | None = None
    without_size: int = 0
    new_identities: bool = False


class Source(ABC):
    """Reads the messages of one topic, in order."""

    def __init__(self, agent: str) -> None:
        self.agent = agent

    @abstractmethod
    def sender(self, message: Any) -> tuple[str, float]:
        """The agent, and the time stamp of its list [s]; 0 for "not set"."""

    @abstractmethod
    def content(self, message: Any, time: float) -> Content:
        """The objects of a message, which were seen at `time` [s].

        Raises:
            ValueError: a bad value; names field and row.
        """


class _Objects(Source):
    """Object lists; their identities are used as long as all objects have one."""

    def __init__(self, agent: str, own_frame: str | None, transforms: Transforms | None) -> None:
        super().__init__(agent)
        self._own_frame, self._transforms = own_frame, transforms
        self._numbers: dict[str, int] | None = {}

    def sender(self, message: Any) -> tuple[str, float]:
        return self.agent, stamp_from_ros(message)

    def content(self, message: Any, time: float) -> Content:
        found = boxes_from_ros(message, self._numbers)
        boxes = self._in_own_frame(found.boxes, str(message.header.frame_id), time)
        _check_boxes(boxes)
        drops = self._numbers is not None and len(found.boxes) > 0 and found.boxes.track_id is None
        were_used = bool(self._numbers)
        if drops:
            self._numbers = None
        return Content(boxes, without_size=found.without_size, new_identities=drops and were_used)

    def _in_own_frame(self, boxes: Boxes, frame: str, time: float) -> Boxes:
        if not is_elsewhere(frame, self._own_frame):
            return boxes
        if self._transforms is None:
            raise ValueError(_fixed(frame))
        return transform_boxes(boxes, self._transforms.between(self._own_frame or _VEHICLE, frame, time))


class _Clouds(Source):
    """Point clouds through the detector and its tracker."""

    def __init__(self, agent: str, detector: PointPillars) -> None:
        super().__init__(agent)
        self._detector, self._perception = detector, _perception(detector)
        self._last = float("-inf")

    def sender(self, message: Any) -> tuple[str, float]:
        frame = str(message.header.frame_id)
        if is_elsewhere(frame, None):
            raise ValueError(_fixed(frame))
        return self.agent, stamp_from_ros(message)

    def content(self, message: Any, time: float) -> Content:
        if time <= self._last:  # the clock was set back
            self._perception = _perception(self._detector)
        self._last = time
        seen = self._perception.step(points_from_ros(message), time)
        boxes = seen.boxes.replace(center=seen.boxes.center - (0.0, 0.0, seen.height_correction))
        return Content(boxes)


class _Messages(Source):
    """CPMs and our own messages, as bytes. The agents are the stations."""

    def sender(self, message: Any) -> tuple[str, float]:
        self._latest = message, _decoded(bytes(bytearray(message.data)))
        return self._latest[1].agent_id, self._latest[1].time

    def content(self, message: Any, time: float) -> Content:
        decoded = self._latest[1] if self._latest[0] is message else _decoded(bytes(bytearray(message.data)))
        _check_boxes(decoded.boxes)
        return Content(decoded.boxes, decoded.body)


def make_source(
    agent: str,
    topic: Topic,
    detector: PointPillars | None = None,
    own_frame: str | None = None,
    transforms: Transforms | None = None,
) -> Source:
    """The source for a topic.

    Args:
        agent: whose topic it is.
        topic: of a type in `cobevglue.replay.topics`.
        detector: for point clouds.
        own_frame: frame into which object lists are brought; None to leave them where they are unless they are in a
            map, and to bring those into `base_link`.
        transforms: for it; filled while the recording is read.
    """
    if topic.type in CLOUDS:
        assert detector is not None
        return _Clouds(agent, detector)
    return _Messages(agent) if topic.type in MESSAGES else _Objects(agent, own_frame, transforms)


def is_elsewhere(frame: str, own_frame: str | None) -> bool:
    """Whether a list in this frame has to be brought into the agent's own: that of a map, or not the one wanted."""
    name = frame.strip("/")
    return name.rsplit("/", 1)[-1] in _FIXED_FRAMES or (own_frame is not None and name != own_frame.strip("/"))


def _decoded(data: bytes) -> ObjectMessage:
    """The object message in these bytes, or that of the SDSM or CPM in them, a CPM also behind its transport header."""
    if data.startswith(_OBJECT_MESSAGE):
        return decode(data)
    from cobevglue.messages import cpm, sdsm

    if data.startswith(_CPM_PORT):
        data = data[4:]
    try:
        message = sdsm.decode(data) if data.startswith(_SDSM) else cpm.decode(data)
        return message.object_message()
    except MessageError as error:
        raise MessageError(f"neither a CPM, an SDSM nor a message of cobevglue: {error}") from None


def _check_boxes(boxes: Boxes) -> None:
    distance, size = np.abs(boxes.center).max(axis=1, initial=0.0), boxes.size.max(axis=1, initial=0.0)
    for name, values, limit in (("center", distance, _FARTHEST), ("size", size, _LARGEST)):
        if (values > limit).any():
            row = int((values > limit).argmax())
            hint = "; the list must be in the agent's own frame" if name == "center" else ""
            raise ValueError(f"{name}: row {row} has {values[row]:.4g} m, at most {limit:g} m are possible{hint}")


def _fixed(frame: str) -> str:
    return (
        f"frame_id: this is in the frame {frame!r}, and there are no transforms (tf) into the agent's own, such as "
        "base_link"
    )


def _perception(detector: PointPillars) -> Perception:
    from cobevglue.perception import Perception

    return Perception(detector)
