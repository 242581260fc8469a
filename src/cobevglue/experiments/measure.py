"""Metrics of a study: average precision, poses, bytes and times of a condition over all sequences."""

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
"""IoU thresholds of true positives."""


@dataclass(eq=False)
class Results:
    """The results of a study.

    Attributes:
        sequences: results of each sequence.
        evaluation_range: x_min, x_max, y_min, y_max [m] of evaluated objects.
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
        """Average precision, in [0, 1]; NaN without evaluated objects.

        Args:
            condition: one that was run.
            iou: one of `IOUS`.
            every: use every n-th frame only; a multiple of the condition's own interval.
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
        """The evaluated frames of all sequences in order, with their ground truth."""
        for sequence in self.sequences:
            for index, frame in sequence.conditions[condition.key].frames.items():
                if index % every == 0:
                    yield sequence.truth[index], frame

    def heard(self, condition: Condition, every: int = 1) -> Iterator[tuple[int, ReceivedPose]]:
        """(number of objects detected by both, collaborator) for every collaborator in every frame."""
        for truth, frame in self.frames(condition, every):
            for one in frame.heard:
                yield truth.co_visible.get(one.agent, 0), one

    def payload_bytes(self, condition: Condition) -> float:
        """Mean bytes that a collaborator sends for fusion in a frame; NaN without any."""
        return _mean([sum(one.message_bytes.values()) - one.alignment_bytes for _, one in self.heard(condition)])

    def alignment_bytes(self, condition: Condition, every: int = 1) -> float:
        """Mean bytes that a collaborator sends for alignment in a frame; NaN without any."""
        return _mean([one.alignment_bytes for _, one in self.heard(condition, every)])

    def milliseconds(self, condition: Condition) -> dict[str, float]:
        """Median time of each stage of a frame, all collaborators together [ms]."""
        frames = [frame.seconds for _, frame in self.frames(condition)]
        return {stage: 1e3 * float(np.median([one[stage] for one in frames])) for stage in (frames or [{}])[0]}

    def perception_milliseconds(self) -> dict[str, float]:
        """Median time of each stage of perception for one cloud [ms]."""
        frames = [
            {stage: seconds / (1 + len(truth.co_visible)) for stage, seconds in truth.seconds.items()}
            for sequence in self.sequences
            for truth in sequence.truth
        ]
        return {stage: 1e3 * float(np.median([one[stage] for one in frames])) for stage in (frames or [{}])[0]}

    @property
    def frame_count(self) -> int:
        """Number of evaluated frames."""
        return sum(len(sequence.truth) for sequence in self.sequences)

    @property
    def lonely_frames(self) -> int:
        """Frames without any collaborator."""
        return sum(not truth.co_visible for sequence in self.sequences for truth in sequence.truth)

    @property
    def left_out(self) -> Counter[str]:
        """Reasons for skipped data, with counts."""
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
    """Shares of all collaborators in all frames; NaN where there are none to divide by.

    Attributes:
        count: number of collaborators.
        refused: share without a pose.
        success_1, success_2, success_3: share with a pose within k m and k degrees.
        wrong: share of the accepted ones that are off by more than 3 m or 3 degrees.
        translation: median error of the accepted ones [m].
        yaw: median error of the accepted ones [degrees].
    """

    count: int
    refused: float
    success_1: float
    success_2: float
    success_3: float
    wrong: float
    translation: float
    yaw: float


def pose_quality(heard: Sequence[ReceivedPose]) -> PoseQuality:
    """Success rates and errors of these collaborators' poses."""
    accepted = [one for one in heard if one.accepted]
    return PoseQuality(
        count=len(heard),
        refused=_mean([not one.accepted for one in heard]),
        success_1=_mean([one.success(1.0) for one in heard]),
        success_2=_mean([one.success(2.0) for one in heard]),
        success_3=_mean([one.success(3.0) for one in heard]),
        wrong=_mean([not one.success(3.0) for one in accepted]),
        translation=float(np.median([one.translation_error for one in accepted])) if accepted else math.nan,
        yaw=math.degrees(np.median([one.yaw_error for one in accepted])) if accepted else math.nan,
    )


def _mean(values: Sequence[float]) -> float:
    return float(np.mean(values)) if values else math.nan
