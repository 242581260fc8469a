"""What a detector is trained on: clouds with the boxes in them, and where they come from."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.datasets import Dataset
from cobevglue.typing import Float32Array, IntArray

__all__ = ["DatasetEpisodes", "EpisodeSource", "Sample", "SampleLike", "count_points"]


@dataclass(frozen=True, eq=False)
class Sample:
    """One cloud and the objects in it.

    Attributes:
        points: (N, 4) x, y, z [m] and intensity [0, 1] in the sensor's frame.
        boxes: K objects in the same frame.
        point_count: (K,) points on each object.

    Raises:
        ValueError: a wrong shape.
    """

    points: Float32Array
    boxes: Boxes
    point_count: IntArray

    def __post_init__(self) -> None:
        if self.points.ndim != 2 or self.points.shape[1] != 4:
            raise ValueError(f"points must have shape (N, 4), got {self.points.shape}")
        if self.point_count.shape != (len(self.boxes),):
            raise ValueError(f"point_count must have shape ({len(self.boxes)},), got {self.point_count.shape}")


class SampleLike(Protocol):
    """Anything with the attributes of a `Sample`; the simulator has a class of its own."""

    @property
    def points(self) -> Float32Array:
        """(N, 4)."""
        ...

    @property
    def boxes(self) -> Boxes:
        """K objects."""
        ...

    @property
    def point_count(self) -> IntArray:
        """(K,)."""
        ...


class EpisodeSource(Protocol):
    """Where samples come from. It is copied into worker processes, so it must be picklable."""

    def episode(self, index: int) -> Sequence[SampleLike]:
        """A few samples that are cheap to make together: snapshots of one simulated world, some frames of a data set.

        Args:
            index: any number from 0; a finite source starts over, in another order.

        Returns:
            The samples; the same for the same source settings (its seed among them) and index, in any process.
        """
        ...


class DatasetEpisodes:
    """Episodes of a data set: some of its frames drawn at random, each with all agents that have a cloud.

    Frames are in a new order in every pass over the data set, so that an episode's samples have little in common.
    """

    def __init__(self, dataset: Dataset, seed: int = 0, frames_per_episode: int = 8) -> None:
        """Look at which frames there are; no cloud is read.

        Args:
            dataset: a split of a data set.
            seed: of the order of frames.
            frames_per_episode: frames that make an episode.

        Raises:
            ValueError: there are no frames.
        """
        self._dataset, self._seed = dataset, seed
        self._frames = [(scenario.name, number) for scenario in dataset for number in range(len(scenario))]
        if not self._frames:
            raise ValueError(f"{dataset}: no frames to train on")
        self._frames_per_episode = min(frames_per_episode, len(self._frames))
        self._pass: tuple[int, IntArray] = (-1, np.zeros(0, dtype=np.int64))

    def __len__(self) -> int:
        """Episodes of one pass over the data set; a last incomplete one is left out."""
        return len(self._frames) // self._frames_per_episode

    def episode(self, index: int) -> Sequence[Sample]:
        """The samples of episode `index`; see `EpisodeSource`.

        Raises:
            ValueError: a broken file; names it.
        """
        number, position = divmod(index, len(self))
        if self._pass[0] != number:
            self._pass = (number, np.random.default_rng([self._seed, number]).permutation(len(self._frames)))
        chosen = self._pass[1][position * self._frames_per_episode : (position + 1) * self._frames_per_episode]
        return list(itertools.chain.from_iterable(self._samples(*self._frames[row]) for row in chosen))

    def _samples(self, scenario: str, number: int) -> list[Sample]:
        agents = self._dataset[scenario][number].agents.values()
        return [
            Sample(agent.points, agent.objects, count_points(agent.points, agent.objects))
            for agent in agents
            if agent.points is not None
        ]


def count_points(points: Float32Array, boxes: Boxes) -> IntArray:
    """Points in each box, its surface included.

    Args:
        points: (N, 4) x, y, z [m], intensity.
        boxes: K boxes in the same frame; one of unknown height (0) counts the points at any height.

    Returns:
        (K,) counts.
    """
    ordered = points[np.argsort(points[:, 0])]  # so that a box looks only at the slab of points that it spans in x
    reach = np.hypot(boxes.size[:, 0], boxes.size[:, 1]) / 2.0
    first = np.searchsorted(ordered[:, 0], boxes.center[:, 0] - reach, side="left")
    last = np.searchsorted(ordered[:, 0], boxes.center[:, 0] + reach, side="right")
    counts = np.zeros(len(boxes), dtype=np.int64)
    for row in range(len(boxes)):
        offset = ordered[first[row] : last[row], :3] - boxes.center[row]
        c, s = np.cos(boxes.yaw[row]), np.sin(boxes.yaw[row])
        length, width, height = boxes.size[row] / 2.0
        inside = (np.abs(c * offset[:, 0] + s * offset[:, 1]) <= length) & (
            np.abs(c * offset[:, 1] - s * offset[:, 0]) <= width
        )
        if height > 0.0:
            inside &= np.abs(offset[:, 2]) <= height
        counts[row] = np.count_nonzero(inside)
    return counts
