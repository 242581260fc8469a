"""The demonstration: two cars at a simulated junction find each other from the objects that both see.

Each frame goes the way it would on the road: each car detects boxes and tracks them, the second car's tracked boxes
are encoded to bytes, decoded by the first, and aligned by BEVGlue, which gets nothing else. Beside it, the same boxes
are placed by other sources of the relative pose: GPS with noise, GPS under attack, and the truth.
"""

from __future__ import annotations

import math
import platform
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.messages import ObjectMessage, decode, encode
from cobevglue.se2 import SE2
from cobevglue.simulation import Junction, ObjectListFrame
from cobevglue.tracking import Sort
from cobevglue.typing import FloatArray

if TYPE_CHECKING:
    from cobevglue.alignment import Alignment

__all__ = ["BEVGLUE", "EGO", "OTHER", "POSE_SOURCES", "TRUE_POSE", "DemoFrame", "DemoResult", "run_demo"]

EGO, OTHER = "car1", "car2"
"""The car that receives, and the one that sends."""

BEVGLUE, TRUE_POSE = "bevglue", "true_pose"
POSE_SOURCES = {
    "gps_0.5": "GPS, noise 0.5 m and 0.5°",
    "gps_2.5": "GPS, noise 2.5 m and 2.5°",
    "gps_attacked": "GPS under attack",
    BEVGLUE: "BEVGlue, no GPS",
    TRUE_POSE: "true pose",
}
"""What the other's boxes are placed with, and how people read it. Noise is a Gaussian on x, y and yaw of both cars; the
attacked car claims to stand where the ego stands."""

WRONG_BEYOND = (3.0, math.radians(3.0))
"""An accepted pose that is further off than this [m, rad] counts as a wrong accept."""
PLACED_WITHIN = 2.0
"""A box nearer than this [m] to its object counts as placed: about the width of a car."""

_GPS_STREAM = 100  # of random numbers; the simulation has the first ones
_GPS_LEVELS = {"gps_0.5": 0.5, "gps_2.5": 2.5}  # standard deviations, in metres and in degrees


@dataclass(frozen=True, eq=False, slots=True)
class DemoFrame:
    """What happened in one frame.

    Attributes:
        index: 0, 1, 2, …
        time: time stamp [s].
        ego: the ego's tracked boxes, in its own frame.
        other: the other's tracked boxes as they were received, in the other's frame.
        alignment: what BEVGlue made of the two.
        poses: ego_SE2_other of each pose source; None where it was refused.
        objects: (N, 2) where the objects of the other's boxes truly are, in the ego's frame [m]; NaN for false boxes.
        new_objects: how many objects the other detected that the ego did not.
        message_bytes: how long the message was.
        align_seconds: how long the alignment took.
        truth: all vehicles but the ego itself, in the ego's frame.
    """

    index: int
    time: float
    ego: Boxes
    other: Boxes
    alignment: Alignment
    poses: dict[str, SE2 | None]
    objects: FloatArray
    new_objects: int
    message_bytes: int
    align_seconds: float
    truth: Boxes

    @property
    def pose_error(self) -> tuple[float, float] | None:
        """How far BEVGlue's pose is off, translation [m] and yaw [rad]; None where it refused."""
        pose, truth = self.poses[BEVGLUE], self.poses[TRUE_POSE]
        return None if pose is None or truth is None else pose.error_to(truth)

    def placement_error(self, source: str) -> FloatArray | None:
        """(K,) how far the other's boxes, placed with this source's pose, are from their objects [m].

        False boxes have no object and do not count. None where the pose was refused.
        """
        pose, real = self.poses[source], np.isfinite(self.objects[:, 0])
        if pose is None:
            return None
        error: FloatArray = np.linalg.norm(pose.apply(self.other.center[real, :2]) - self.objects[real], axis=1)
        return error


@dataclass(frozen=True, eq=False, slots=True)
class DemoResult:
    """The whole sequence.

    Attributes:
        seed: of the scene.
        frames: what happened, frame by frame.
    """

    seed: int
    frames: tuple[DemoFrame, ...]

    def summary(self) -> dict[str, Any]:
        """The numbers of the sequence, ready for JSON; rates are shares of all frames, units are in the names."""
        errors = [error for frame in self.frames if (error := frame.pose_error) is not None]
        n = len(self.frames)
        milliseconds = 1e3 * np.array([frame.align_seconds for frame in self.frames])
        return {
            "seed": self.seed,
            "frames": n,
            "objects_per_frame": {
                "ego": _mean([len(frame.ego) for frame in self.frames]),
                "other": _mean([len(frame.other) for frame in self.frames]),
                "matched": _mean([len(frame.alignment.matches) for frame in self.frames]),
                "new_from_other": _mean([frame.new_objects for frame in self.frames]),
            },
            "alignment": {
                **{f"success_{level}m_{level}deg": _success(errors, level) / n for level in (1, 2, 3)},
                "refused": 1.0 - len(errors) / n,
                "wrong_accepts": sum(m > WRONG_BEYOND[0] or rad > WRONG_BEYOND[1] for m, rad in errors) / n,
                "median_error_m": _median([metres for metres, _ in errors]),
                "median_error_deg": _median([math.degrees(radians) for _, radians in errors]),
                "median_ms": _median(milliseconds),
                "slowest_ms": float(milliseconds.max()),
            },
            "message_bytes_per_frame": _mean([frame.message_bytes for frame in self.frames]),
            "placement": {source: self._placement(source) for source in POSE_SOURCES},
            "machine": {"processor": platform.machine(), "python": platform.python_version()},
        }

    def _placement(self, source: str) -> dict[str, float | None]:
        """How well the other's boxes are placed with the poses of this source."""
        given = [errors for frame in self.frames if (errors := frame.placement_error(source)) is not None]
        placed = np.concatenate(given) if given else np.zeros(0)
        boxes = sum(int(np.isfinite(frame.objects[:, 0]).sum()) for frame in self.frames)
        return {
            "mean_error_m": _mean(placed),
            "boxes_within_2m": float((placed < PLACED_WITHIN).sum() / boxes) if boxes else None,
            "frames": len(given) / len(self.frames),
        }


def run_demo(seed: int = 0, *, frames: int = 80, progress: Callable[[int], None] | None = None) -> DemoResult:
    """Simulate the junction and align every frame.

    Args:
        seed: of the scene and of the GPS noise, a whole number >= 0.
        frames: how many of the scene's frames, at 10 Hz; at most 80.
        progress: called after each frame with the number of frames done.

    Returns:
        What happened; the same for the same seed, but for the times that were measured.

    Raises:
        ValueError: the seed is negative or the number of frames is out of range.
    """
    from cobevglue.alignment import BEVGlue

    scene = Junction(seed)
    if not 1 <= frames <= len(scene):
        raise ValueError(f"frames must be from 1 to {len(scene)}, got {frames}")
    _compile(scene[0])
    trackers = {EGO: Sort(), OTHER: Sort()}
    glue = BEVGlue()
    done = []
    for frame in (scene[index] for index in range(frames)):
        tracked = {name: trackers[name].update(frame.agents[name].boxes, frame.time) for name in (EGO, OTHER)}
        message = encode(ObjectMessage(OTHER, frame.time, frame.index, tracked[OTHER]))
        received = decode(message).boxes
        start = time.perf_counter()
        alignment = glue.align(tracked[EGO], received, time=frame.time)
        seconds = time.perf_counter() - start
        done.append(_compare(frame, tracked[EGO], received, alignment, len(message), seconds, seed))
        if progress is not None:
            progress(len(done))
    return DemoResult(seed, tuple(done))


def _compile(frame: ObjectListFrame) -> None:
    """Have the kernels compiled, or loaded from their cache, before any time is taken."""
    from cobevglue.alignment import BEVGlue

    ego, other = (Sort().update(frame.agents[name].boxes) for name in (EGO, OTHER))
    glue = BEVGlue()
    for _ in range(2):  # the second frame uses what was remembered of the first
        glue.align(ego, other)


def _compare(
    frame: ObjectListFrame,
    ego: Boxes,
    received: Boxes,
    alignment: Alignment,
    message_bytes: int,
    seconds: float,
    seed: int,
) -> DemoFrame:
    """Hold BEVGlue's pose, and the others, against the truth."""
    mine, theirs = frame.agents[EGO], frame.agents[OTHER]
    poses: dict[str, SE2 | None] = {
        **{source: _noisy_gps(frame, level, seed) for source, level in _GPS_LEVELS.items()},
        "gps_attacked": SE2(),
        BEVGLUE: alignment.ego_SE2_other,
        TRUE_POSE: frame.ego_SE2_other(EGO, OTHER),
    }
    real = theirs.object_id >= 0
    truth = frame.objects.transform(mine.world_SE2_agent.inverse())
    objects = np.full((len(received), 2), np.nan)
    objects[real] = truth.center[theirs.object_id[real], :2]  # object ids are rows of the scene's objects
    return DemoFrame(
        index=frame.index,
        time=frame.time,
        ego=ego,
        other=received,
        alignment=alignment,
        poses=poses,
        objects=objects,
        new_objects=len(set(theirs.object_id[real].tolist()) - {mine.own_id, *mine.object_id.tolist()}),
        message_bytes=message_bytes,
        align_seconds=seconds,
        truth=truth[np.arange(len(truth)) != mine.own_id],
    )


def _noisy_gps(frame: ObjectListFrame, level: float, seed: int) -> SE2:
    """ego_SE2_other from the two cars' own positions, each with Gaussian noise of `level` metres and degrees."""
    rng = np.random.default_rng([seed, _GPS_STREAM, frame.index])
    claimed = []
    for name in (EGO, OTHER):
        pose, (x, y, yaw) = frame.agents[name].world_SE2_agent, level * rng.standard_normal(3)
        claimed.append(SE2(pose.x + x, pose.y + y, pose.yaw + math.radians(yaw)))
    return claimed[0].inverse() @ claimed[1]


def _success(errors: list[tuple[float, float]], level: float) -> int:
    """How many poses are off by at most `level` metres and degrees."""
    return sum(metres <= level and radians <= math.radians(level) for metres, radians in errors)


def _mean(values: Any) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _median(values: Any) -> float | None:
    return float(np.median(values)) if len(values) else None
