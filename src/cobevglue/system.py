"""The whole system: equation (1) of CoBEVGlue, one line a step.

system = CoBEVGlue.pretrained("compact", fusion="cobevglue", aligner="bevglue")
out = system.step({"car1": points1, "car2": points2}, ego="car1", time=0.0)
out.boxes, out.alignments["car2"], out.message_bytes["car2"]
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from time import perf_counter

import numpy as np
from torch import nn

from cobevglue.alignment import Alignment, group_aligner
from cobevglue.alignment.group import GroupAligner, Observation
from cobevglue.boxes import Boxes, covers_origin
from cobevglue.datasets.frame import did_you_mean
from cobevglue.fusion import CompressedFusion, Compression, FusionMethod, Received, pretrained_fusion
from cobevglue.fusion.heading import vote_headings
from cobevglue.fusion.none import NoCollaboration
from cobevglue.messages import decode_arrays, encode_arrays
from cobevglue.perception import Perception, PerceptionOutput, PointPillars
from cobevglue.perception.fold_batch_norm import fold_batch_norm
from cobevglue.typing import ArrayLike, FloatArray

__all__ = ["CoBEVGlue", "StepOutput"]


@dataclass(frozen=True, slots=True, eq=False)
class StepOutput:
    """The result of one frame.

    Attributes:
        boxes: the detected vehicles without the ego itself, with score, in its LiDAR frame, best first.
        alignments: of every other agent; those refused are not fused.
        message_bytes: encoded size of each other agent's messages: {"boxes": …, "features": …}, and "points", "pose" or
            "variance" where such data were sent.
        alignment_bytes: the part of it that was sent for alignment.
        seconds: time spent in each stage [s]; perception is the sum over agents.
    """

    boxes: Boxes
    alignments: dict[str, Alignment]
    message_bytes: dict[str, dict[str, int]]
    alignment_bytes: dict[str, int]
    seconds: dict[str, float]


class CoBEVGlue:
    """Collaborative perception of several agents (equation 1 of the paper).

    All agents run the same detector; each has its own tracker. Agents may appear and disappear between frames.

    Args:
        detector: from points to features and boxes.
        fusion: the fusion method.
        aligner: the source of relative poses.
    """

    def __init__(self, detector: PointPillars, fusion: FusionMethod, aligner: GroupAligner) -> None:
        self.detector, self.fusion, self.aligner = detector, fusion, aligner
        self._perception: dict[str, Perception] = {}
        self._ego: str | None = None
        self._frame = 0

    @classmethod
    def pretrained(
        cls,
        name: str,
        fusion: str = "cobevglue",
        aligner: str | None = None,
        compression: Compression | None = None,
    ) -> CoBEVGlue:
        """The system on the weights that come with the package.

        Args:
            name: of the detector: "compact", or "opv2v", for which fusion has to be "late", "early" or "none".
            fusion: a name in `FUSION_METHODS`.
            aligner: a name in `ALIGNERS`; None for that of the method's paper.
            compression: of the transmitted features; None for none.

        Raises:
            ValueError: an unknown name (names the nearest), or messages that cannot be compressed so.
        """
        detector = PointPillars.pretrained(name)
        method = pretrained_fusion(fusion, detector, name)
        if isinstance(method, nn.Module):
            method = fold_batch_norm(method)
        if compression is not None:
            method = CompressedFusion(method, compression)
        return cls(fold_batch_norm(detector), method, group_aligner(aligner or method.usual_aligner))

    def reset(self) -> None:
        """Forget all tracks and poses: the next frame is the first of another sequence."""
        self._perception.clear()
        self.aligner.reset()
        self._ego, self._frame = None, 0

    def step(
        self,
        points: Mapping[str, ArrayLike],
        ego: str,
        time: float | None = None,
        poses: Mapping[str, ArrayLike] | None = None,
        bodies: Mapping[str, Boxes] | None = None,
        times: Mapping[str, float] | None = None,
    ) -> StepOutput:
        """The next frame.

        Args:
            points: (N, 4) x, y, z [m], intensity of every agent's cloud, each in its own LiDAR frame.
            ego: the agent in whose frame the result is.
            time: of the clouds [s]; by default 0.1 s after the last.
            poses: (4, 4) world_SE3_lidar of every agent as its localisation claims, for aligners that need one; may be
                left out with fusion "none", which needs none: all others are then refused.
            bodies: one-row box of the own vehicle of each agent that knows it, in its LiDAR frame; transmitted with
                the agent's boxes.
            times: time stamp of each agent's cloud that has one of its own [s], on any clock; transmitted with its
                boxes.

        Raises:
            ValueError: no such ego, a cloud or pose of a wrong shape, or `time` not later than the last; names the
                agent.
        """
        if ego not in points:
            raise ValueError(f"ego: there is no agent {did_you_mean(ego, points)}")
        start = perf_counter()
        stamps = times or {}
        seen = {agent: self.perceive(agent, cloud, stamps.get(agent, time)) for agent, cloud in points.items()}  # (1a)
        seconds = {"perception": perf_counter() - start}
        return self.collaborate(seen, ego, time, poses, seconds, bodies, times)

    def perceive(self, agent: str, points: ArrayLike, time: float | None = None) -> PerceptionOutput:
        """Equation (1a): the perception of one agent. See `step` for the arguments."""
        perception = self._perception.setdefault(agent, Perception(self.detector))
        try:
            return perception.step(points, time)
        except ValueError as error:
            raise ValueError(f"{agent}: {error}") from None

    def collaborate(
        self,
        seen: Mapping[str, PerceptionOutput],
        ego: str,
        time: float | None = None,
        poses: Mapping[str, ArrayLike] | None = None,
        seconds: Mapping[str, float] | None = None,
        bodies: Mapping[str, Boxes] | None = None,
        times: Mapping[str, float] | None = None,
    ) -> StepOutput:
        """Equations (1b) to (1e): from the agents' observations to the ego's result. See `step` for the arguments."""
        if ego != self._ego:  # aligners filter the poses in the ego frame
            self.aligner.reset()
            self._ego = ego
        spent = dict(seconds or {})
        sent: dict[str, dict[str, int]] = {agent: {"boxes": 0, "features": 0} for agent in seen if agent != ego}

        with _timed("alignment", spent):
            if poses is None and "pose" in self.aligner.needs and isinstance(self.fusion, NoCollaboration):
                observations = {agent: Observation() for agent in seen}
                refused = Alignment.refused("no poses are given, and nothing is fused")
                alignments = {agent: refused for agent in seen if agent != ego}
            else:
                observations = self._observe(seen, ego, time, poses, bodies or {}, times or {}, sent)
                alignments = self.aligner.align_group(ego, observations, time)  # (1b)
        alignment_bytes = {agent: sum(parts.values()) for agent, parts in sent.items()}

        with _timed("messages", spent):
            received = []
            for agent, alignment in alignments.items():
                message = self.fusion.message(seen[agent])
                data = encode_arrays(message) if message else b""
                sent[agent][self.fusion.kind] = sent[agent].get(self.fusion.kind, 0) + len(data)
                if alignment.ego_SE2_other is not None and message:
                    pose = alignment.ego_SE2_list or alignment.ego_SE2_other
                    received.append(Received(decode_arrays(data), pose, alignment, observations[agent].boxes))

        with _timed("fusion", spent):
            boxes = self.fusion.fuse(seen[ego], received)  # (1c) to (1e)
            boxes = vote_headings(boxes, _transmitted(seen[ego], observations, alignments))
            boxes = boxes[~covers_origin(boxes)]  # others see the ego, too
            boxes = boxes.replace(center=boxes.center - (0.0, 0.0, seen[ego].height_correction))
        self._frame += 1
        return StepOutput(boxes, alignments, sent, alignment_bytes, spent)

    def _observe(
        self,
        seen: Mapping[str, PerceptionOutput],
        ego: str,
        time: float | None,
        poses: Mapping[str, ArrayLike] | None,
        bodies: Mapping[str, Boxes],
        times: Mapping[str, float],
        sent: dict[str, dict[str, int]],
    ) -> dict[str, Observation]:
        """The aligner's inputs: for other agents, as decoded from messages, whose bytes are added to `sent`."""
        observations = {}
        for agent, view in seen.items():
            pose = _pose(agent, poses) if poses is not None and "pose" in self.aligner.needs else None
            whole = Observation(
                view.boxes, bodies.get(agent), view.variance, view.points, view.features, pose, times.get(agent)
            )
            try:
                needed = self.aligner.select_inputs(whole)
            except ValueError as error:
                raise ValueError(f"{agent}: {error}") from None
            if agent != ego:
                stamp = times.get(agent, time)
                parts = self.aligner.encode(agent, needed, 0.0 if stamp is None else stamp, self._frame)
                needed = self.aligner.decode(parts, needed)
                sent[agent].update({kind: len(data) for kind, data in parts.items()})
            observations[agent] = needed
        return observations


def _transmitted(
    ego: PerceptionOutput, observations: Mapping[str, Observation], alignments: Mapping[str, Alignment]
) -> Iterator[Boxes]:
    """The ego's own boxes, and the received boxes of aligned agents, in the ego frame."""
    yield ego.boxes
    for agent, alignment in alignments.items():
        boxes = observations[agent].boxes
        if boxes is not None and alignment.ego_SE2_other is not None:
            yield alignment.boxes_at_ego_instant(boxes)


def _pose(agent: str, poses: Mapping[str, ArrayLike]) -> FloatArray:
    if agent not in poses:
        raise ValueError(f"poses: {agent}: missing")
    pose = np.asarray(poses[agent], dtype=np.float64)
    if pose.shape != (4, 4) or not np.isfinite(pose).all():
        raise ValueError(f"poses: {agent}: must be finite numbers of shape (4, 4), got shape {pose.shape}")
    return pose


@contextmanager
def _timed(stage: str, seconds: dict[str, float]) -> Iterator[None]:
    start = perf_counter()
    yield
    seconds[stage] = perf_counter() - start
