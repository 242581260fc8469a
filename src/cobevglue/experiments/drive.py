"""Perception over a drive: what every agent saw in every frame, and the truth about it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.datasets.frame import AgentFrame, Frame
from cobevglue.datasets.labelled_cloud import count_points
from cobevglue.datasets.poses import inverse_SE3, transform_boxes
from cobevglue.disturbance import Moment
from cobevglue.experiments.results import FrameTruth
from cobevglue.iou import bev_iou
from cobevglue.perception import Perception, PerceptionOutput, PointPillars
from cobevglue.typing import BoolArray, Float32Array

__all__ = ["Drive"]

_DETECTED_IOU = 0.1
"""An object is detected when a tracked box overlaps it by more."""


@dataclass
class Drive:
    """What is seen on a drive. `moments` and `truth` grow as `see` goes on.

    The ego is the first vehicle, in the order of names, of the first frame in which a vehicle has a cloud. Agents
    without a cloud are not there, and frames without the ego are left out; both are counted. Agents may come and go.

    Attributes:
        detector: of all agents.
        ego: its name; "" before it was seen.
        moments: what all agents saw. Views that are older than those of the last `see` are forgotten, poses are kept.
        truth: of the same frames.
        left_out: what was not used, and how often.
    """

    detector: PointPillars
    ego: str = ""
    moments: list[Moment] = field(default_factory=list)
    truth: list[FrameTruth] = field(default_factory=list)
    left_out: Counter[str] = field(default_factory=Counter)
    _perception: dict[str, Perception] = field(default_factory=dict)

    def see(self, frames: Iterable[Frame]) -> range:
        """Go on through these frames.

        Returns:
            The numbers of the new moments.

        Raises:
            ValueError: a broken file; names it.
        """
        first = len(self.moments)
        for frame in frames:
            self._see(frame)
        return range(first, len(self.moments))

    def forget_views(self, before: int) -> None:
        """Give back the memory of what was seen before moment `before`; poses stay."""
        for index in range(before):
            old = self.moments[index]
            if old.seen:
                self.moments[index] = Moment(old.time, {}, old.claimed, old.true)

    def _see(self, frame: Frame) -> None:
        clouds = dict(self._clouds(frame))
        if not self.ego:
            self.ego = next((name for name in clouds if not frame.agents[name].is_infrastructure), "")
        if not self.ego or self.ego not in clouds:
            self.left_out["frames without the ego"] += 1
            return
        agents = {name: frame.agents[name] for name in clouds}
        seen = {}
        for name, points in clouds.items():
            perception = self._perception.setdefault(name, Perception(self.detector))
            seen[name] = perception.step(points, frame.time)
        poses = {name: agent.world_SE3_lidar for name, agent in agents.items()}
        self.moments.append(Moment(frame.time, seen, poses, poses))
        self.truth.append(_truth(frame, self.ego, agents, seen))

    def _clouds(self, frame: Frame) -> Iterator[tuple[str, Float32Array]]:
        for name, agent in frame.agents.items():
            points = agent.points
            if points is None:
                self.left_out["agents without a cloud"] += 1
            else:
                yield name, points


def _truth(
    frame: Frame, ego: str, agents: Mapping[str, AgentFrame], seen: Mapping[str, PerceptionOutput]
) -> FrameTruth:
    objects = frame.ground_truth(ego)
    points = np.zeros(len(objects), np.int64)
    detected: dict[str, BoolArray] = {}
    for name, agent in agents.items():
        agent_SE3_ego = inverse_SE3(agent.world_SE3_lidar) @ agents[ego].world_SE3_lidar
        there = transform_boxes(objects, agent_SE3_ego)
        raised = there.replace(center=there.center + (0.0, 0.0, seen[name].raised))
        points += count_points(seen[name].points, raised)
        detected[name] = _detected(there, seen[name].boxes)
    co_visible = {name: int((detected[ego] & rows).sum()) for name, rows in detected.items() if name != ego}
    seconds = Counter[str]()
    for view in seen.values():
        seconds.update(view.seconds)
    return FrameTruth(frame.timestamp, objects.replace(track_id=None), points, co_visible, dict(seconds))


def _detected(objects: Boxes, boxes: Boxes) -> BoolArray:
    """(N,) whether there is a box of each object."""
    found: BoolArray = np.any(bev_iou(objects, boxes) > _DETECTED_IOU, axis=1)
    return found
