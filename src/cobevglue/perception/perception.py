"""Equation (1a) of CoBEVGlue: from one agent's points to its features and its tracked boxes."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter

import numpy as np
import torch
from torch import Tensor

from cobevglue.boxes import Boxes
from cobevglue.perception.level import lifted, needed_raise
from cobevglue.perception.point_pillars import PointPillars, check_points
from cobevglue.tracking import Sort
from cobevglue.typing import ArrayLike, Float32Array, FloatArray

__all__ = ["Perception", "PerceptionOutput"]


@dataclass(frozen=True, slots=True, eq=False)
class PerceptionOutput:
    """What one agent sees in one frame, in its LiDAR's frame, but raised where the sensor stands unusually high or low.

    Attributes:
        points: (N, 4) float32 x, y, z [m], intensity: the cloud's measurements, raised.
        features: three maps (C, rows, columns) at strides 2, 4 and 8, on the detector's device.
        boxes: detections good enough to be tracked, with `track_id`: what the agent tells others. Each faces the way
            that most detections of its track did; the rest is as it was seen now.
        variance: (K, 3) predicted variance of x, y [m^2] and yaw [rad^2] of the K `boxes`.
        detections: all detections, best first, down to the detector's own threshold; those in `boxes` face as there.
        seconds: time spent in each stage [s].
        raised: what was added to z [m] (`needed_raise`): 0 for a sensor on the roof of a car. Points and boxes of all
            agents have the ground at the same height so.
        dropped: how many points of the cloud were no measurements, and left out (`check_points`).
    """

    points: Float32Array
    features: tuple[Tensor, Tensor, Tensor]
    boxes: Boxes
    variance: FloatArray
    detections: Boxes
    seconds: dict[str, float]
    raised: float = 0.0
    dropped: int = 0


class Perception:
    """Detector and tracker of one agent. Agents may share a detector, never a tracker.

    Args:
        detector: in evaluation mode.
        tracker: with default settings if None.
        min_track_score: detections that score less are not tracked and not told to others: a false box is worse there
            than a missing one.
    """

    def __init__(self, detector: PointPillars, tracker: Sort | None = None, min_track_score: float = 0.25) -> None:
        if not 0.0 <= min_track_score <= 1.0:
            raise ValueError(f"min_track_score must be in [0, 1], got {min_track_score}")
        self.detector = detector
        self.tracker = tracker or Sort()
        self.min_track_score = min_track_score

    def reset(self) -> None:
        """Forget all tracks."""
        self.tracker.reset()

    @torch.inference_mode()
    def step(self, points: ArrayLike, time: float | None = None) -> PerceptionOutput:
        """The next frame.

        Args:
            points: (N, 4) x, y, z [m], intensity, in the LiDAR's frame.
            time: when it was taken [s]; by default the tracker's period after the last.

        Raises:
            ValueError: `points` is not numbers of shape (N, 4), or `time` is not later than the last.
        """
        checked = check_points(points)
        dropped = len(np.asarray(points)) - len(checked)
        raised = needed_raise(checked)
        checked = lifted(checked, raised)
        seconds: dict[str, float] = {}
        with self._timed("pillars", seconds):
            image = self.detector.encode([torch.from_numpy(checked)])
        with self._timed("backbone", seconds):
            first, second, third = self.detector.multiscale(image)
        with self._timed("head", seconds):
            output = self.detector.decode_features((first, second, third))
        with self._timed("boxes", seconds):
            (found,) = self.detector.boxes(output)
        with self._timed("facing", seconds):
            detections, variance, sure = self.detector.faced(found, checked)
        with self._timed("tracking", seconds):
            assert detections.score is not None
            good = detections.score >= self.min_track_score
            tracked = self.tracker.faced(self.tracker.update(detections[good], time, sure[good]))
            yaw = detections.yaw.copy()
            yaw[good] = tracked.yaw
            detections = detections.replace(yaw=yaw)
        features = (first[0], second[0], third[0])
        return PerceptionOutput(checked, features, tracked, variance[good], detections, seconds, raised, dropped)

    @contextmanager
    def _timed(self, stage: str, seconds: dict[str, float]) -> Iterator[None]:
        start = perf_counter()
        yield
        if self.detector.device.type == "cuda":  # which answers before it is done
            torch.cuda.synchronize(self.detector.device)
        seconds[stage] = perf_counter() - start
