"""The transforms that vehicles record (`tf2_msgs/TFMessage`), to bring lists from a map into the vehicle's own frame.

A list in a map was moved there by the vehicle's own localisation. The same localisation moves it back, so that what is
left does not depend on it, whether it is right or wrong.
"""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation, Slerp

from cobevglue.datasets.poses import inverse_SE3
from cobevglue.typing import FloatArray

__all__ = ["TRANSFORMS", "Transforms", "transform_topics"]

TRANSFORMS = "tf2_msgs/msg/TFMessage"
"""Type of the topics with transforms."""
_KEPT = 2000
"""Transforms of a frame that are kept: some seconds, as lists come later than what they show."""
_NEAR = 0.5
"""A moving frame is known at a time if one of its transforms is not farther from it [s]."""


class Transforms:
    """The tree of frames of one vehicle. Static transforms hold at any time."""

    def __init__(self) -> None:
        self._parents: dict[str, str] = {}
        self._poses: dict[str, deque[tuple[float, FloatArray, FloatArray]]] = {}

    def add(self, message: Any) -> None:
        """Take over the transforms of a TFMessage."""
        for item in message.transforms:
            child, stamp = _name(item.child_frame_id), item.header.stamp
            parent, where, turn = _name(item.header.frame_id), item.transform.translation, item.transform.rotation
            if self._parents.get(child) != parent:
                self._parents[child], self._poses[child] = parent, deque(maxlen=_KEPT)
            self._poses[child].append(
                (
                    stamp.sec + 1e-9 * stamp.nanosec,
                    np.array([where.x, where.y, where.z], dtype=np.float64),
                    np.array([turn.x, turn.y, turn.z, turn.w], dtype=np.float64),
                )
            )

    def between(self, target: str, source: str, time: float) -> FloatArray:
        """(4, 4) target_SE3_source at a time [s].

        Raises:
            ValueError: there is no chain of transforms between the frames, or none near this time.
        """
        target, source = _name(target), _name(source)
        to_target, target_root = self._to_root(target, time)
        to_source, source_root = self._to_root(source, time)
        if target_root != source_root:
            known = ", ".join(sorted({*self._parents, *self._parents.values()})) or "none yet"
            raise ValueError(f"there is no transform from {source!r} to {target!r}; there are the frames {known}")
        return inverse_SE3(to_target) @ to_source

    def _to_root(self, frame: str, time: float) -> tuple[FloatArray, str]:
        """(4, 4) root_SE3_frame, and the root."""
        pose, seen = np.eye(4), {frame}
        while frame in self._parents:
            pose = self._at(frame, time) @ pose
            frame = self._parents[frame]
            if frame in seen:
                raise ValueError(f"the transforms go round in a circle at {frame!r}")
            seen.add(frame)
        return pose, frame

    def _at(self, frame: str, time: float) -> FloatArray:
        """(4, 4) parent_SE3_frame, interpolated between the transforms before and after a time."""
        poses = self._poses[frame]
        offset = np.array([stamp - time for stamp, _, _ in poses])
        if len(poses) > 1 and np.abs(offset).min() > _NEAR:
            raise ValueError(f"the nearest transform of {frame!r} is {np.abs(offset).min():.2f} s away")
        start, where, turn = poses[int(np.where(offset <= 0.0, offset, -np.inf).argmax())]  # the last one before
        end, next_where, next_turn = poses[int(np.where(offset >= 0.0, offset, np.inf).argmin())]
        pose = np.eye(4)
        if not start <= time < end:  # it is none: all are later, or all earlier
            _, where, turn = poses[int(np.abs(offset).argmin())]
            pose[:3, 3], pose[:3, :3] = where, Rotation.from_quat(turn).as_matrix()
            return pose
        pose[:3, 3] = where + (time - start) / (end - start) * (next_where - where)
        pose[:3, :3] = Slerp([start, end], Rotation.from_quat([turn, next_turn]))(time).as_matrix()
        return pose


def transform_topics(agent_topic: str, topics: dict[str, str]) -> list[str]:
    """The topics with the transforms of an agent: `/a/tf` before `/tf` for `/a/objects`, and the static ones.

    Args:
        agent_topic: on which its lists are.
        topics: types of all topics by name.
    """
    parts = agent_topic.split("/")[:-1]
    for depth in range(len(parts), 0, -1):
        space = "/".join(parts[:depth])
        found = [name for name in (f"{space}/tf", f"{space}/tf_static") if topics.get(name) == TRANSFORMS]
        if f"{space}/tf" in found:
            return found
    return []


def _name(frame: Any) -> str:
    return str(frame).strip("/")
