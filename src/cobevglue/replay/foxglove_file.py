"""The results of a replay as an MCAP file for Foxglove and Lichtblick, written by foxglove-sdk (the extra `ros`).

| topic | content |
|---|---|
| `/cobevglue/tf` | FrameTransform from the ego's frame to that of each aligned agent |
| `/cobevglue/AGENT/objects` | SceneUpdate: its boxes in the ego frame at the ego's instant; gone while it is refused |
| `/cobevglue/fused` | SceneUpdate: everyone's objects |
| `/cobevglue/AGENT/verdict` | JSON to plot: accepted, risk, time_offset, x, y, yaw_deg, matches; text: reason |
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from io import RawIOBase
from pathlib import Path
from typing import Any

import numpy as np

from cobevglue.alignment import Alignment
from cobevglue.boxes import Boxes
from cobevglue.replay.replay import ReplayFrame
from cobevglue.typing import FloatArray
from cobevglue.visualization.style import EGO, MATCH, OTHER

__all__ = ["FoxgloveFile", "open_foxglove_file"]

_PREFIX = "/cobevglue"
_FLAT = 0.1
"""Height of a box whose height is not known [m]."""
_PLOTS = ("accepted", "risk", "time_offset", "x", "y", "yaw_deg", "matches")
_VERDICT = {
    "type": "object",
    "properties": {**{name: {"type": "number"} for name in _PLOTS}, "reason": {"type": "string"}},
}


class FoxgloveFile:
    """An MCAP file that is being written; see `open_foxglove_file`."""

    def __init__(self, library: Any, context: Any, target: _Target, ego: str) -> None:
        self._library, self._context, self._target, self._ego = library, context, target, ego
        self._channels: dict[str, Any] = {}

    def write(self, frame: ReplayFrame) -> None:
        """Write a frame.

        Raises:
            OSError: the file cannot be written.
        """
        now, seen = round(1e9 * frame.time), frame.seen
        self._scene(f"{_PREFIX}/{self._ego}/objects", seen.lists[self._ego], EGO, now)
        self._scene(f"{_PREFIX}/fused", seen.objects, MATCH, now)
        for name, alignment in seen.alignments.items():
            accepted = alignment.ego_SE2_other is not None
            moved = alignment.boxes_at_ego_instant(seen.lists[name]) if accepted else Boxes.empty()
            self._scene(f"{_PREFIX}/{name}/objects", moved, OTHER, now)
            self._transform(name, alignment, now)
            self._verdict(name, alignment, now)
        self._target.check()

    def _channel(self, topic: str, kind: str) -> Any:
        if topic not in self._channels:
            channels = self._library.channels
            self._channels[topic] = (
                self._library.Channel(topic, schema=_VERDICT, message_encoding="json", context=self._context)
                if kind == "json"
                else getattr(channels, f"{kind}Channel")(topic, context=self._context)
            )
        return self._channels[topic]

    def _scene(self, topic: str, boxes: Boxes, color: str, now: int) -> None:
        m = self._library.messages
        cubes = [
            m.CubePrimitive(
                pose=m.Pose(position=self._vector(boxes.center[row]), orientation=self._orientation(boxes.yaw[row])),
                size=self._vector(np.maximum(boxes.size[row], _FLAT)),
                color=m.Color(**_rgb(color), a=0.45),
            )
            for row in range(len(boxes))
        ]
        entity = m.SceneEntity(timestamp=self._time(now), frame_id=self._ego, id=topic, cubes=cubes)
        self._channel(topic, "SceneUpdate").log(m.SceneUpdate(entities=[entity]), log_time=now)

    def _transform(self, agent: str, alignment: Alignment, now: int) -> None:
        pose = alignment.ego_SE2_other
        if pose is not None:
            m = self._library.messages
            transform = m.FrameTransform(
                timestamp=self._time(now),
                parent_frame_id=self._ego,
                child_frame_id=agent,
                translation=self._vector(np.array([pose.x, pose.y, 0.0])),
                rotation=self._orientation(pose.yaw),
            )
            self._channel(f"{_PREFIX}/tf", "FrameTransform").log(transform, log_time=now)

    def _verdict(self, agent: str, alignment: Alignment, now: int) -> None:
        pose = alignment.ego_SE2_other
        values = {"accepted": float(pose is not None), "matches": len(alignment.matches), "risk": alignment.risk}
        if pose is not None:
            place = {"x": pose.x, "y": pose.y, "yaw_deg": math.degrees(pose.yaw)}
            values |= {"time_offset": alignment.time_offset, **place}
        known = {key: value for key, value in values.items() if math.isfinite(value)}
        document = {**known, "reason": alignment.reason}
        self._channel(f"{_PREFIX}/{agent}/verdict", "json").log(document, log_time=now)

    def _vector(self, xyz: FloatArray) -> Any:
        x, y, z = xyz.tolist()
        return self._library.messages.Vector3(x=x, y=y, z=z)

    def _orientation(self, yaw: float) -> Any:
        return self._library.messages.Quaternion(x=0.0, y=0.0, z=math.sin(yaw / 2.0), w=math.cos(yaw / 2.0))

    def _time(self, nanoseconds: int) -> Any:
        return self._library.messages.Timestamp(*divmod(nanoseconds, 10**9))


@contextmanager
def open_foxglove_file(path: str | Path, ego: str) -> Iterator[FoxgloveFile]:
    """Write an MCAP file, complete when the block ends.

    Args:
        path: of the file; replaced if it exists.
        ego: name of the ego, and of the frame of everything.

    Raises:
        OSError: the file cannot be written.
        ModuleNotFoundError: foxglove-sdk is not installed.
    """
    try:
        import foxglove
        import foxglove.channels
        import foxglove.messages
    except ImportError as error:
        raise ModuleNotFoundError(
            f"MCAP files need foxglove-sdk: pip install 'cobevglue[ros]' ({error})", name="foxglove"
        ) from None
    with Path(path).open("wb", buffering=0) as file:
        target = _Target(file)
        context = foxglove.Context()
        writer = foxglove.open_mcap(target, context=context)
        try:
            yield FoxgloveFile(foxglove, context, target, ego)
        finally:
            writer.close()
        target.check()


class _Target:
    """The file that foxglove-sdk writes to. It keeps the first error of writing, which the SDK would only log."""

    def __init__(self, file: RawIOBase) -> None:
        self._file = file
        self._error: OSError | None = None

    def check(self) -> None:
        """Raise the error of writing, if there was one."""
        if self._error is not None:
            raise self._error

    def write(self, data: bytes | bytearray) -> int:
        try:
            return self._file.write(data) or 0
        except OSError as error:
            self._error = self._error or error
            return len(data)

    def seek(self, offset: int, whence: int = 0) -> int:
        return self._file.seek(offset, whence)

    def flush(self) -> None:
        """Nothing is buffered."""


def _rgb(color: str) -> dict[str, float]:
    """Red, green and blue of #rrggbb, 0 to 1."""
    return {name: int(color[i : i + 2], 16) / 255.0 for name, i in (("r", 1), ("g", 3), ("b", 5))}
