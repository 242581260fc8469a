"""Collaboration by object lists: the poses of other agents, and all agents' objects in the ego frame.

    collaboration = ObjectCollaboration()
    seen = collaboration.step({"car1": boxes1, "car2": boxes2}, ego="car1", time=0.0)
    seen.alignments["car2"], seen.objects

What `cobevglue.system.CoBEVGlue` does for point clouds, for agents that have a detector of their own. Imports no torch.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cobevglue.alignment import Alignment, GroupAligner, Observation, group_aligner
from cobevglue.box_merging import merge_boxes
from cobevglue.boxes import Boxes, covers_origin
from cobevglue.clock import Clock
from cobevglue.datasets.frame import did_you_mean
from cobevglue.se2 import SE2
from cobevglue.tracking import Sort
from cobevglue.typing import BoolArray

__all__ = ["FusedObjects", "ObjectCollaboration"]

_PERIOD = 0.1
"""Time between steps that come without a time [s]."""


@dataclass(frozen=True, slots=True, eq=False)
class FusedObjects:
    """The result of one step.

    Attributes:
        objects: all agents' objects without the ego itself, in the ego frame at the ego's instant, merged by
            `merge_boxes`, best first; with score (made of 1 where a list has none) and label ("" likewise), without
            track ids.
        alignments: of every other agent; the lists of those refused are not fused.
        lists: the lists as they were aligned, each in its agent's frame, with `track_id`.
    """

    objects: Boxes
    alignments: dict[str, Alignment]
    lists: dict[str, Boxes]


class ObjectCollaboration:
    """Aligns and fuses the object lists of several agents. Keeps an aligner for each collaborator, and trackers.

    Agents may come and go. Lists without track ids are tracked, by one tracker an agent.

    Args:
        aligner: the source of relative poses; by default a `BEVGlue` for each collaborator.
    """

    def __init__(self, aligner: GroupAligner | None = None) -> None:
        self.aligner = aligner or group_aligner("bevglue")
        self.reset()

    def reset(self) -> None:
        """Forget all tracks and poses: the next step is the first of another sequence."""
        self.aligner.reset()
        self._clock = Clock(_PERIOD)
        self._ego: str | None = None
        self._trackers: dict[str, Sort] = {}
        self._latest: dict[str, tuple[float, Boxes]] = {}

    def forget(self, agent: str) -> None:
        """Forget the tracks and the pose of one agent: its next list does not continue its last one."""
        self.aligner.forget(agent)
        self._latest.pop(agent, None)
        self._trackers.pop(agent, None)

    def step(
        self,
        objects: Mapping[str, Boxes],
        ego: str,
        time: float | None = None,
        times: Mapping[str, float] | None = None,
        bodies: Mapping[str, Boxes] | None = None,
    ) -> FusedObjects:
        """Process the ego's next list, and the newest list of every other agent.

        Args:
            objects: of every agent, in its own frame.
            ego: the agent in whose frame the result is.
            time: of the ego's list [s]; by default 0.1 s after the last step.
            times: time stamp of each list that has one of its own [s], on any clock. A list with the time stamp of the
                agent's last one is that list again: its tracks are kept.
            bodies: one-row box of the own vehicle of each agent that knows it, in its own frame. The others observe
                it as an object, and it is fused as one.

        Raises:
            ValueError: no such ego, a body that has not one row, or a time that is not later than the last (of the ego)
                or earlier than the last (of the others); names the agent.
        """
        if ego not in objects:
            raise ValueError(f"ego: there is no agent {did_you_mean(ego, objects)}")
        if ego != self._ego:  # aligners filter the poses in the ego frame
            self.aligner.reset()
            self._clock.reset()
            self._ego = ego
        self._clock.advance(time)
        now = self._clock.time
        assert now is not None
        stamps, known = times or {}, bodies or {}
        lists = {agent: self._tracked(agent, boxes, stamps.get(agent, now)) for agent, boxes in objects.items()}
        observations = {
            agent: Observation(boxes, known.get(agent), time=stamps.get(agent)) for agent, boxes in lists.items()
        }
        alignments = self.aligner.align_group(ego, observations, now)
        return FusedObjects(_fused(lists, ego, alignments, known), alignments, lists)

    def _tracked(self, agent: str, boxes: Boxes, time: float) -> Boxes:
        """The list with track ids: its own, the tracker's, or those it got before if it is the same list again."""
        if agent in self._latest:
            last, tracked = self._latest[agent]
            if time < last:
                raise ValueError(f"{agent}: time must not be earlier than the last one, {last} s, got {time} s")
            if time == last:
                return tracked
        if boxes.track_id is None:
            try:
                boxes = self._trackers.setdefault(agent, Sort()).update(boxes, time)
            except ValueError as error:
                raise ValueError(f"{agent}: {error}") from None
        self._latest[agent] = time, boxes
        return boxes


def _fused(
    lists: Mapping[str, Boxes], ego: str, alignments: Mapping[str, Alignment], bodies: Mapping[str, Boxes]
) -> Boxes:
    """All agents' objects in the ego frame, merged."""
    parts = [_comparable(lists[ego])]
    for agent, alignment in alignments.items():
        if alignment.ego_SE2_other is not None:
            received = _comparable(alignment.boxes_at_ego_instant(lists[agent]))
            if agent in bodies:
                own = _comparable(bodies[agent].transform(alignment.ego_SE2_other))
                received = Boxes.concatenate([received, own])
            parts.append(received[~_is_ego(received, bodies.get(ego))])
    return merge_boxes(parts)


def _comparable(boxes: Boxes) -> Boxes:
    """Boxes with scores (1 if there are none), with labels ("" likewise), and without track ids, which are per list."""
    score = np.ones(len(boxes)) if boxes.score is None else boxes.score
    label = np.full(len(boxes), "") if boxes.label is None else boxes.label
    return boxes.replace(score=score, label=label, track_id=None)


def _is_ego(boxes: Boxes, body: Boxes | None) -> BoolArray:
    """(N,) whether a box is the ego itself: it stands on the middle of its vehicle, or on its frame's origin."""
    middle = np.zeros(2) if body is None else body.center[0, :2]
    return covers_origin(boxes.transform(SE2(-middle[0], -middle[1], 0.0)))
