"""Metrics of a study: average precision, pose errors, bytes and times of a condition over all sequences."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np

from cobevglue.evaluation.detection import evaluate_detections
from cobevglue.evaluation.detection_matching import DetectionFrame, EvaluationRange, inside
from cobevglue.experiments.condition import Condition
from cobevglue.experiments.results import FrameResult, FrameTruth, ReceivedPose, ScenarioResult

__all__ = ["IOUS", "PoseQuality", "Results", "pose_quality"]

IOUS = (0.3, 0.5, 0.7)
"""IoU thresholds of a true detection."""


@dataclass(eq=False)
class Results:
    """The results of a study.

    Attributes:
        sequences: the results of each sequence.
        evaluation_range: x_min, x_max, y_min, y_max [m].
        min_points: objects with fewer points are ignored.
    """

    sequences: Sequence[ScenarioResult]
    evaluation_range: EvaluationRange
    min_points: int
    _precision: dict[tuple[str, int], dict[float, float]] = field(default_factory=dict)

    def has(self, condition: Condition) -> bool:
        """Whether the condition was run."""
        return all(condition.key in sequence.conditions for sequence in self.sequences)

    def ap(self, condition: Condition, iou: float, every: int = 1) -> float:
        """Average precision, in [0, 1]; NaN without any evaluated object.

        Args:
            condition: one that was run.
            iou: one of `IOUS`.
            every: step between the frames that are used; a multiple of the condition's.
        """
        key = condition.key, every
        if key not in self._precision:
            report = evaluate_detections(
                (
                    DetectionFrame(frame.boxes, truth.objects, truth.point_count, truth.timestamp)
                    for truth, frame in self.frames(condition, every)
                ),
                IOUS,
                self.evaluation_range,
                self.min_points,
                range_bins=(),
            )
            self._precision[key] = {one: report.ap(one) for one in IOUS}
        return self._precision[key][iou]

    def frames(self, condition: Condition, every: int = 1) -> Iterator[tuple[FrameTruth, FrameResult]]:
        """Ground truth and result of each frame that was run, sequence by sequence."""
        for sequence in self.sequences:
            for index, frame in sequence.conditions[condition.key].frames.items():
                if index % every == 0:
                    yield sequence.truth[index], frame

    def received_poses(self, condition: Condition, every: int = 1) -> Iterator[tuple[int, ReceivedPose]]:
        """For each collaborator and frame, the number of objects that both it and the ego detected, and its pose."""
        for truth, frame in self.frames(condition, every):
            for pose in frame.received:
                yield truth.co_visible.get(pose.agent, 0), pose

    def payload_bytes(self, condition: Condition, every: int = 1) -> float:
        """Mean bytes for fusion that one collaborator sends in one frame; NaN without any."""
        poses = [pose for _, pose in self.received_poses(condition, every)]
        return _mean([sum(pose.message_bytes.values()) - pose.alignment_bytes for pose in poses])

    def alignment_bytes(self, condition: Condition, every: int = 1) -> float:
        """Mean bytes for alignment that one collaborator sends in one frame; NaN without any."""
        return _mean([pose.alignment_bytes for _, pose in self.received_poses(condition, every)])

    def milliseconds(self, condition: Condition) -> dict[str, float]:
        """Median time of each stage for one frame with all collaborators [ms]."""
        frames = [frame.seconds for _, frame in self.frames(condition)]
        return {stage: 1e3 * float(np.median([one[stage] for one in frames])) for stage in (frames or [{}])[0]}

    def perception_milliseconds(self) -> dict[str, float]:
        """Median time of each perception stage for one cloud [ms]."""
        frames = [
            {stage: seconds / (1 + len(truth.co_visible)) for stage, seconds in truth.seconds.items()}
            for sequence in self.sequences
            for truth in sequence.truth
        ]
        return {stage: 1e3 * float(np.median([one[stage] for one in frames])) for stage in (frames or [{}])[0]}

    @property
    def frame_count(self) -> int:
        """Number of frames used."""
        return sum(len(sequence.truth) for sequence in self.sequences)

    @property
    def frames_without_collaborators(self) -> int:
        """Number of frames without any collaborator."""
        return sum(not truth.co_visible for sequence in self.sequences for truth in sequence.truth)

    @property
    def left_out(self) -> Counter[str]:
        """Reasons for skipping, with their counts."""
        total: Counter[str] = Counter()
        for sequence in self.sequences:
            total.update(sequence.left_out)
        return total

    @property
    def object_count(self) -> int:
        """Number of evaluated objects in all frames."""
        return sum(
            int((inside(truth.objects, self.evaluation_range) & (truth.point_count >= self.min_points)).sum())
            for sequence in self.sequences
            for truth in sequence.truth
        )


@dataclass(frozen=True, slots=True)
class PoseQuality:
    """Pose quality over all collaborators and frames; NaN where the denominator is 0.

    Attributes:
        count: number of received poses, refused ones included.
        refused: share of refused poses.
        success_1, success_2, success_3: share with errors below k m and k degrees.
        wrong: share of the accepted ones with an error of 3 m or 3 degrees or more.
        translation: median translation error of the accepted ones [m].
        yaw: median yaw error of the accepted ones [degrees].
    """

    count: int
    refused: float
    success_1: float
    success_2: float
    success_3: float
    wrong: float
    translation: float
    yaw: float


def pose_quality(poses: Sequence[ReceivedPose]) -> PoseQuality:
    """The quality of these poses."""
    accepted = [pose for pose in poses if pose.accepted]
    return PoseQuality(
        count=len(poses),
        refused=_mean([not pose.accepted for pose in poses]),
        success_1=_mean([pose.success(1.0) for pose in poses]),
        success_2=_mean([pose.success(2.0) for pose in poses]),
        success_3=_mean([pose.success(3.0) for pose in poses]),
        wrong=_mean([not pose.success(3.0) for pose in accepted]),
        translation=float(np.median([pose.translation_error for pose in accepted])) if accepted else math.nan,
        yaw=math.degrees(np.median([pose.yaw_error for pose in accepted])) if accepted else math.nan,
    )


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else math.nan
