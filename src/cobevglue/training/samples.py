"""Where clouds to train on come from."""

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
    """Where samples come from. It is copied into worker processes, so it must be picklable."""

    def episode(self, index: int) -> Sequence[LabelledCloud]:
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

    def episode(self, index: int) -> Sequence[LabelledCloud]:
        """The samples of episode `index`; see `EpisodeSource`.

        Raises:
            ValueError: a broken file; names it.
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
