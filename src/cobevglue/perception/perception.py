"""Perception of one agent, equation (1a) of CoBEVGlue: features and tracked boxes from a point cloud."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter

import numpy as np
import torch
from torch import Tensor

from cobevglue.boxes import Boxes
from cobevglue.perception.ground_height import correct_height, estimate_height_correction
from cobevglue.perception.point_pillars import PointPillars, check_points
from cobevglue.tracking import Sort
from cobevglue.typing import ArrayLike, Float32Array, FloatArray

__all__ = ["Perception", "PerceptionOutput"]


@dataclass(frozen=True, slots=True, eq=False)
class PerceptionOutput:
    """The perception of one agent in one frame, in its LiDAR frame after ground-height normalisation.

    Attributes:
        points: (N, 4) float32 x, y, z [m], intensity: the normalised cloud.
        features: three maps (C, rows, columns) at strides 2, 4 and 8, on the detector's device.
        boxes: the tracked detections with `track_id`, which the agent transmits. Front and back are decided by a vote
            of all detections of a track; everything else is of this frame.
        variance: (K, 3) predicted variance of x, y [m^2] and yaw [rad^2] of the K `boxes`.
        detections: all detections above the detector's threshold, by descending score, with the headings of `boxes`.
        seconds: time spent in each stage [s].
        height_correction: the offset added to z [m] (`estimate_height_correction`), so that the ground is at the same
            height for all agents; 0 for a sensor on a car's roof.
        dropped_points: number of invalid points: not finite, or at (0, 0, 0).
    """

    points: Float32Array
    features: tuple[Tensor, Tensor, Tensor]
    boxes: Boxes
    variance: FloatArray
    detections: Boxes
    seconds: dict[str, float]
    height_correction: float = 0.0
    dropped_points: int = 0


class Perception:
    """Detector and tracker of one agent. Agents may share a detector but not a tracker.

    Args:
        detector: in evaluation mode.
        tracker: with default settings if None.
        min_track_score: detections with lower scores are neither tracked nor transmitted: for alignment a false box is
            worse than a missing one.
    """

    def __init__(self, detector: PointPillars, tracker: Sort | None = None, min_track_score: float = 0.25) -> None:
        if not 0.0 <= min_track_score <= 1.0:
            raise ValueError(f"min_track_score must be in [0, 1], got {min_track_score}")
        self.detector = detector
        self.tracker = tracker or Sort()
        self.min_track_score = min_track_score

    def reset(self) -> None:
        """Delete all tracks."""
        self.tracker.reset()

    @torch.inference_mode()
    def step(self, points: ArrayLike, time: float | None = None) -> PerceptionOutput:
        """Process the next frame.

        Args:
            points: (N, 4) x, y, z [m], intensity, in the LiDAR's frame.
            time: time stamp [s]; by default the tracker's period after the previous one.

        Raises:
            ValueError: `points` is not numeric of shape (N, 4), or `time` is not later than the previous one.
        """
        checked = check_points(points)
        dropped = len(np.asarray(points)) - len(checked)
        offset = estimate_height_correction(checked)
        checked = correct_height(checked, offset)
        seconds: dict[str, float] = {}
        with self._timed("pillars", seconds):
            image = self.detector.encode([torch.from_numpy(checked)])
        with self._timed("backbone", seconds):
            first, second, third = self.detector.multiscale(image)
        with self._timed("head", seconds):
            output = self.detector.decode_features((first, second, third))
        with self._timed("boxes", seconds):
            (unrefined,) = self.detector.boxes(output)
        with self._timed("heading", seconds):
            detections, variance, heading_confidence = self.detector.refine_headings(unrefined, checked)
        with self._timed("tracking", seconds):
            assert detections.score is not None
            good = detections.score >= self.min_track_score
            tracked = self.tracker.vote_headings(self.tracker.update(detections[good], time, heading_confidence[good]))
            yaw = detections.yaw.copy()
            yaw[good] = tracked.yaw
            detections = detections.replace(yaw=yaw)
        features = (first[0], second[0], third[0])
        return PerceptionOutput(checked, features, tracked, variance[good], detections, seconds, offset, dropped)

    @contextmanager
    def _timed(self, stage: str, seconds: dict[str, float]) -> Iterator[None]:
        start = perf_counter()
        yield
        if self.detector.device.type == "cuda":  # kernels run asynchronously
            torch.cuda.synchronize(self.detector.device)
        seconds[stage] = perf_counter() - start
