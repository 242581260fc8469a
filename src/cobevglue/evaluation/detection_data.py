"""Clouds with their truth, to measure a detector on: every agent's own cloud of a data set, or simulated ones."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.datasets import Scenario
from cobevglue.datasets.labelled_cloud import LabelledCloud, count_points
from cobevglue.evaluation.detection_matching import DetectionFrame
from cobevglue.typing import Float32Array, IntArray

__all__ = ["Cloud", "Detector", "Episodes", "dataset_clouds", "detect", "simulated_clouds"]


class Detector(Protocol):
    """What finds boxes in a cloud, such as `PointPillars`."""

    def detect(self, points: Float32Array, /) -> Boxes:
        """Boxes with scores in the frame of the points (N, 4)."""
        ...


class Episodes(Protocol):
    """A source of clouds without end, such as `SimulatedEpisodes`."""

    def episode(self, index: int) -> Sequence[LabelledCloud]:
        """The clouds of episode `index`, from 0."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class Cloud:
    """One agent's cloud at one time, and the objects that this agent could see, in its LiDAR frame.

    Attributes:
        frame: name of the frame, with that of its scenario.
        agent: name of the agent.
        points: (N, 4) x, y, z [m], intensity; None where no cloud is stored, or no labels for it.
        truth: K boxes; none where `points` is None.
        point_count: (K,) points in each of them.
        missing_labels: where a file of the labels or of their calibration is not there, the error that names it.
    """

    frame: str
    agent: str
    points: Float32Array | None
    truth: Boxes
    point_count: IntArray
    missing_labels: str | None = None


def dataset_clouds(scenarios: Iterable[Scenario]) -> Iterator[Cloud]:
    """Every agent of every frame, in order, with its own labels; also those without a cloud or labels, to be counted.

    Args:
        scenarios: a split of a data set, or some of its scenarios.

    Raises:
        ValueError: a broken file; names it.
    """
    for scenario in scenarios:
        for frame in scenario:
            for name, agent in frame.agents.items():
                points, where = agent.points, f"{frame.scenario}/{frame.timestamp}"
                nothing = Cloud(where, name, None, Boxes.empty(), np.zeros(0, dtype=np.int64))
                if points is None:
                    yield nothing
                    continue
                try:
                    objects = agent.objects
                except FileNotFoundError as error:
                    yield replace(nothing, missing_labels=str(error))
                else:
                    yield Cloud(where, name, points, objects, count_points(points, objects))


def simulated_clouds(source: Episodes, count: int) -> Iterator[Cloud]:
    """The first `count` clouds of simulated episodes."""
    made, index = 0, 0
    while made < count:
        for number, sample in enumerate(source.episode(index)[: count - made]):
            yield Cloud(f"episode {index}", f"sample {number}", sample.points, sample.boxes, sample.point_count)
            made += 1
        index += 1


def detect(cloud: Cloud, detector: Detector) -> DetectionFrame:
    """What the detector finds in a cloud, next to the truth.

    Raises:
        ValueError: the frame has no cloud or no labels.
    """
    if cloud.points is None:
        raise ValueError(f"{cloud.frame}: {cloud.agent}: {cloud.missing_labels or 'no cloud is stored'}")
    found = detector.detect(cloud.points)
    counts = count_points(cloud.points, found)
    return DetectionFrame(found, cloud.truth, cloud.point_count, cloud.frame, cloud.agent, counts)
