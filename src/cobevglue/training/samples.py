"""Sources of training samples: episodes of labelled clouds."""

from __future__ import annotations

import itertools
import warnings
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from cobevglue.datasets import Dataset
from cobevglue.datasets.labelled_cloud import LabelledCloud, count_points
from cobevglue.typing import IntArray

__all__ = ["DatasetEpisodes", "EpisodeSource"]


class EpisodeSource(Protocol):
    """Source of samples. It must be picklable, because it is copied to worker processes."""

    def episode(self, index: int) -> Sequence[LabelledCloud]:
        """The samples of an episode: snapshots of one simulated world, or some frames of a data set.

        Args:
            index: from 0, without an upper limit; a finite source starts over in a different order.

        Returns:
            The samples. They depend only on the settings of the source, its seed included, and on `index`.
        """
        ...


class DatasetEpisodes:
    """Episodes of a data set: random frames, each with all agents that have a cloud.

    Frames are shuffled anew in every pass over the data set, so samples of an episode are little correlated.
    """

    def __init__(self, dataset: Dataset, seed: int = 0, frames_per_episode: int = 8) -> None:
        """List the frames, without reading clouds.

        Args:
            dataset: a split of a data set.
            seed: of the order of frames.
            frames_per_episode: number of frames in an episode.

        Raises:
            ValueError: the data set has no frames.
        """
        self._dataset, self._seed = dataset, seed
        self._frames = [(scenario.name, number) for scenario in dataset for number in range(len(scenario))]
        if not self._frames:
            raise ValueError(f"{dataset}: no frames to train on")
        self._frames_per_episode = min(frames_per_episode, len(self._frames))
        self._pass: tuple[int, IntArray] = (-1, np.zeros(0, dtype=np.int64))

    def __len__(self) -> int:
        """Number of episodes in one pass over the data set; an incomplete last one is omitted."""
        return len(self._frames) // self._frames_per_episode

    def episode(self, index: int) -> Sequence[LabelledCloud]:
        """The samples of episode `index`; see `EpisodeSource`.

        Raises:
            ValueError: a damaged file; the message names it.
        """
        number, position = divmod(index, len(self))
        if self._pass[0] != number:
            self._pass = (number, np.random.default_rng([self._seed, number]).permutation(len(self._frames)))
        chosen = self._pass[1][position * self._frames_per_episode : (position + 1) * self._frames_per_episode]
        return list(itertools.chain.from_iterable(self._samples(*self._frames[row]) for row in chosen))

    def _samples(self, scenario: str, number: int) -> list[LabelledCloud]:
        samples = []
        for agent in self._dataset[scenario][number].agents.values():
            points = agent.points
            if points is None:
                continue
            try:
                objects = agent.objects
            except FileNotFoundError as error:
                warnings.warn(f"a cloud without labels is left out: {error}", stacklevel=2)
                continue
            samples.append(LabelledCloud(points, objects, count_points(points, objects)))
        return samples
