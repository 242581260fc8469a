"""Runs one sequence under many conditions. Perception is run once, and each method encodes each message once."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from itertools import islice
from time import perf_counter

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.datasets.frame import Scenario
from cobevglue.disturbance import Disturbance, ObservedFrame
from cobevglue.evaluation.alignment import landing_error
from cobevglue.experiments.condition import Condition
from cobevglue.experiments.models import Models
from cobevglue.experiments.observed_sequence import ObservedSequence
from cobevglue.experiments.results import ConditionResult, FrameResult, ReceivedPose, ScenarioResult
from cobevglue.experiments.study import StudySettings, sequence_frames
from cobevglue.fusion import FusionMethod, Received
from cobevglue.messages import Arrays
from cobevglue.perception import PerceptionOutput
from cobevglue.se2 import SE2
from cobevglue.system import CoBEVGlue, StepOutput

__all__ = ["PERCEPTION_COST", "MessageMemo", "run_sequence"]

PERCEPTION_COST = 10
"""Cost of perception relative to one condition, both for one frame; for the estimate of the remaining time."""
_BLOCK = 20
"""Number of frames per block. The current block and the previous one, which disturbances may use, are in memory."""

_Progress = Callable[[float], None]


def run_sequence(
    settings: StudySettings,
    sequence: Scenario,
    number: int,
    conditions: Sequence[Condition],
    models: Models,
    progress: _Progress = lambda work: None,
) -> ScenarioResult:
    """Run a sequence under all conditions.

    Args:
        settings: of the study.
        sequence: consecutive frames.
        number: index of the sequence in the study; part of the random seed.
        conditions: with distinct keys.
        models: the networks.
        progress: called with the work since the last call, in frames of one condition.

    Raises:
        ValueError: a broken file; names it.
    """
    observed = ObservedSequence(models.detector)
    sent = [(condition.fusion, condition.compression) for condition in conditions]
    memos = {key: MessageMemo(models.fusion(condition)) for key, condition in zip(sent, conditions, strict=True)}
    runs = [
        _Run(condition, models, memos[key], (settings.seed, number))
        for key, condition in zip(sent, conditions, strict=True)
    ]
    runs.sort(key=lambda run: list(memos).index(run.sends))  # so that only one memo is full at a time
    frames = iter(sequence_frames(settings, sequence))
    while block := list(islice(frames, _BLOCK)):
        new = observed.observe(block)
        progress(PERCEPTION_COST * len(block))
        sends = None
        for run in runs:
            if run.sends != sends:
                sends = run.sends
                for memo in memos.values():
                    memo.clear()
            for index in new:
                run.step(observed, index)
            progress(len(block) / run.condition.every)
        for memo in memos.values():
            memo.clear()
        observed.drop_observations(before=new.start)
    return ScenarioResult(
        sequence.name,
        observed.ego,
        observed.truth,
        dict(observed.left_out),
        {
            run.condition.key: ConditionResult(run.condition, models.fingerprint(run.condition), run.frames)
            for run in runs
        },
    )


class _Run:
    """The state of one condition in a sequence."""

    def __init__(self, condition: Condition, models: Models, memo: MessageMemo, key: tuple[int, ...]) -> None:
        self.condition = condition
        self.sends = condition.fusion, condition.compression
        self.frames: dict[int, FrameResult] = {}
        self._memo = memo
        self._system = CoBEVGlue(models.detector, memo, models.aligner(condition))
        self._disturbance: Disturbance = condition.make_disturbance()
        self._key = key

    def step(self, observed: ObservedSequence, index: int) -> None:
        """Run the next frame, frame `index`."""
        if index % self.condition.every:
            return
        frame = self._disturbance.apply(observed.frames, index, observed.ego, self._key)
        if self.condition.forget:
            self._system.aligner.reset()
        poses = frame.true if self.condition.true_poses else frame.claimed
        self._memo.saved = 0.0
        out = self._system.collaborate(frame.observations, observed.ego, frame.time, poses, bodies=frame.own_vehicles)
        out.seconds["messages"] += self._memo.saved
        received = tuple(_received_poses(frame, observed.ego, out))
        self.frames[index] = FrameResult(_without_labels(out.boxes), received, out.seconds)


def _received_poses(frame: ObservedFrame, ego: str, out: StepOutput) -> Iterator[ReceivedPose]:
    for agent, alignment in out.alignments.items():
        translation = yaw = landing = math.inf
        pose = alignment.ego_SE2_list or alignment.ego_SE2_other
        if pose is not None:
            truth = SE2.from_matrix(np.linalg.inv(frame.true[ego]) @ frame.true[agent])
            translation, yaw = pose.error_to(truth)
            landing = landing_error(pose, truth, frame.observations[agent].boxes)
        yield ReceivedPose(
            agent, translation, yaw, landing, alignment.reason, out.message_bytes[agent], out.alignment_bytes[agent]
        )


def _without_labels(boxes: Boxes) -> Boxes:
    """The boxes without labels and track ids, which are not stored."""
    return boxes.replace(label=None, track_id=None)


class MessageMemo(FusionMethod):
    """A fusion method that caches the message of each observation.

    Args:
        method: the fusion method.

    Attributes:
        saved: time that cached messages took when they were encoded [s]; may be set to 0 at any time.
    """

    def __init__(self, method: FusionMethod) -> None:
        self._method = method
        self.kind = method.kind  # type: ignore[misc]  # of this method
        self.saved = 0.0
        self._made: dict[int, tuple[PerceptionOutput, Arrays, float]] = {}

    def clear(self) -> None:
        """Empty the cache."""
        self._made.clear()

    def message(self, observation: PerceptionOutput) -> Arrays:
        """The method's message."""
        if id(observation) in self._made:
            _, message, seconds = self._made[id(observation)]
            self.saved += seconds
            return message
        start = perf_counter()
        message = self._method.message(observation)
        self._made[id(observation)] = observation, message, perf_counter() - start  # the reference keeps the id valid
        return message

    def fuse(self, ego: PerceptionOutput, received: Sequence[Received]) -> Boxes:
        """The method's boxes."""
        return self._method.fuse(ego, received)
