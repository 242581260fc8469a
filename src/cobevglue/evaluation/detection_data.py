"""Labelled clouds to evaluate a detector on: the clouds of all agents of a data set, or simulated ones."""

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
    """Interface of detectors, such as `PointPillars`."""

    def detect(self, points: Float32Array, /) -> Boxes:
        """Detect boxes with scores, in the frame of the points (N, 4)."""
        ...


class Episodes(Protocol):
    """An infinite source of labelled clouds, such as `SimulatedEpisodes`."""

    def episode(self, index: int) -> Sequence[LabelledCloud]:
        """The clouds of episode `index`, from 0."""
        ...


@dataclass(frozen=True, eq=False, slots=True)
class Cloud:
    """The cloud and labels of one agent in one frame, in its LiDAR frame.

    Attributes:
        frame: names of scenario and frame.
        agent: name of the agent.
        points: (N, 4) x, y, z [m], intensity; None if the cloud or its labels are missing.
        truth: K boxes; none if `points` is None.
        point_count: (K,) number of points in each box.
        missing_labels: error message that names the missing label or calibration file, if any.
    """

    frame: str
    agent: str
    points: Float32Array | None
    truth: Boxes
    point_count: IntArray
    missing_labels: str | None = None


def dataset_clouds(scenarios: Iterable[Scenario]) -> Iterator[Cloud]:
    """The clouds of every agent of every frame, in order, with its own labels; missing ones are included.

    Args:
        scenarios: a split of a data set, or some of its scenarios.

    Raises:
        ValueError: a malformed file; the message names it.
    """
    for scenario in scenarios:
        for frame in scenario:
            for name, agent in frame.agents.items():
                points, where = agent.points, f"{frame.scenario}/{frame.timestamp}"
                missing = Cloud(where, name, None, Boxes.empty(), np.zeros(0, dtype=np.int64))
                if points is None:
                    yield missing
                    continue
                try:
                    objects = agent.objects
                except FileNotFoundError as error:
                    yield replace(missing, missing_labels=str(error))
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
    """Run the detector on a cloud and combine the detections with the ground truth.

    Raises:
        ValueError: the frame has no cloud or no labels.
    """
    if cloud.points is None:
        raise ValueError(f"{cloud.frame}: {cloud.agent}: {cloud.missing_labels or 'no cloud is stored'}")
    detections = detector.detect(cloud.points)
    counts = count_points(cloud.points, detections)
    return DetectionFrame(detections, cloud.truth, cloud.point_count, cloud.frame, cloud.agent, counts)
