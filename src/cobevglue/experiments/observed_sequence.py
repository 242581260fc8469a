"""Perception over a sequence: the observations of every agent in every frame, and the ground truth."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.datasets.frame import AgentFrame, Frame
from cobevglue.datasets.labelled_cloud import count_points
from cobevglue.datasets.poses import inverse_SE3, transform_boxes
from cobevglue.disturbance import ObservedFrame
from cobevglue.experiments.results import FrameTruth
from cobevglue.iou import bev_iou
from cobevglue.perception import Perception, PerceptionOutput, PointPillars
from cobevglue.typing import BoolArray, Float32Array

__all__ = ["ObservedSequence"]

_DETECTED_IOU = 0.1
"""An object is detected when a tracked box overlaps it by more."""


@dataclass
class ObservedSequence:
    """Observations of all agents over a sequence. `frames` and `truth` grow with each call of `observe`.

    The ego is the first vehicle, in the order of names, of the first frame in which a vehicle has a cloud. Agents
    without a cloud, frames without the ego, and frames of which a label or calibration file is missing are skipped and
    counted. Agents may come and go.

    Attributes:
        detector: of all agents.
        ego: its name; "" before the first frame with an ego.
        frames: observations and poses of all agents; `drop_observations` frees the former.
        truth: ground truth of the same frames.
        left_out: reasons for skipping, with their counts.
    """

    detector: PointPillars
    ego: str = ""
    frames: list[ObservedFrame] = field(default_factory=list)
    truth: list[FrameTruth] = field(default_factory=list)
    left_out: Counter[str] = field(default_factory=Counter)
    _perception: dict[str, Perception] = field(default_factory=dict)
    _own_vehicles: dict[str, Boxes] = field(default_factory=dict)

    def observe(self, frames: Iterable[Frame]) -> range:
        """Run the perception of all agents on the next frames of the sequence.

        Returns:
            The indices of the new frames.

        Raises:
            ValueError: a broken file; names it.
        """
        first = len(self.frames)
        for frame in frames:
            self._observe(frame)
        return range(first, len(self.frames))

    def drop_observations(self, before: int) -> None:
        """Free the memory of the observations before frame `before`; poses are kept."""
        for index in range(before):
            old = self.frames[index]
            if old.observations:
                self.frames[index] = replace(old, observations={})

    def _observe(self, frame: Frame) -> None:
        clouds = dict(self._clouds(frame))
        if not self.ego:
            self.ego = next((name for name in clouds if not frame.agents[name].is_infrastructure), "")
        if not self.ego or self.ego not in clouds:
            self.left_out["frames without the ego"] += 1
            return
        agents = {name: frame.agents[name] for name in clouds}
        try:
            poses = {name: agent.world_SE3_lidar for name, agent in agents.items()}
            objects = frame.ground_truth(self.ego)
        except FileNotFoundError:
            self.left_out["frames without a label or calibration file"] += 1
            return
        observed = {}
        for name, points in clouds.items():
            perception = self._perception.setdefault(name, Perception(self.detector))
            observed[name] = perception.step(points, frame.time)
        self._own_vehicles.update({name: own for name in agents if (own := frame.own_vehicle(name)) is not None})
        self.frames.append(ObservedFrame(frame.time, observed, poses, poses, dict(self._own_vehicles)))
        self.truth.append(_truth(frame.timestamp, objects, self.ego, agents, observed))

    def _clouds(self, frame: Frame) -> Iterator[tuple[str, Float32Array]]:
        for name, agent in frame.agents.items():
            points = agent.points
            if points is None:
                self.left_out["agents without a cloud"] += 1
            else:
                yield name, points


def _truth(
    timestamp: str,
    objects: Boxes,
    ego: str,
    agents: Mapping[str, AgentFrame],
    observed: Mapping[str, PerceptionOutput],
) -> FrameTruth:
    points = np.zeros(len(objects), np.int64)
    detected: dict[str, BoolArray] = {}
    for name, agent in agents.items():
        agent_SE3_ego = inverse_SE3(agent.world_SE3_lidar) @ agents[ego].world_SE3_lidar
        there = transform_boxes(objects, agent_SE3_ego)
        raised = there.replace(center=there.center + (0.0, 0.0, observed[name].height_correction))
        points += count_points(observed[name].points, raised)
        detected[name] = _detected(there, observed[name].boxes)
    co_visible = {name: int((detected[ego] & rows).sum()) for name, rows in detected.items() if name != ego}
    seconds = Counter[str]()
    for output in observed.values():
        seconds.update(output.seconds)
    return FrameTruth(timestamp, objects.replace(track_id=None), points, co_visible, dict(seconds))


def _detected(objects: Boxes, boxes: Boxes) -> BoolArray:
    """(N,) whether each object was detected."""
    found: BoolArray = np.any(bev_iou(objects, boxes) > _DETECTED_IOU, axis=1)
    return found
