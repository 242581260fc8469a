"""The endless row of training samples, cut into epochs and shared out among processes and their workers."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

import numpy as np
from torch.utils.data import IterableDataset, get_worker_info

from cobevglue.datasets.labelled_cloud import LabelledCloud
from cobevglue.training.samples import EpisodeSource

__all__ = ["EpisodeStream", "FixedStream"]

Item = TypeVar("Item")

_STREAM = 0x7A11
"""Keeps these random numbers apart from others that are drawn with the same seed."""
_MAX_EMPTY = 100
"""So many episodes without a sample in a row are taken for a broken source."""


class EpisodeStream(IterableDataset[Item], Generic[Item]):
    """Samples of all epochs to come, one after the other, for one process.

    Which samples an epoch has, in what order and how changed, depends on nothing but the seed, the epoch and the
    number of processes and workers: a run that is resumed at an epoch sees what the uninterrupted one would have.

    A worker holds the samples of a few episodes and draws from them at random, since the samples of one episode look
    alike. While the process validates, its workers are already busy with the next epoch.
    """

    def __init__(
        self,
        source: EpisodeSource,
        prepare: Callable[[LabelledCloud, np.random.Generator], Item],
        *,
        epochs: range,
        batches_per_epoch: int,
        batch_size: int,
        seed: int,
        pool: int,
        uses: int = 1,
        rank: int = 0,
        processes: int = 1,
    ) -> None:
        """Nothing is made before the first sample is asked for.

        Args:
            source: gives the episodes.
            prepare: makes an item of a sample: augmentation, targets.
            epochs: which ones, in steps of 1.
            batches_per_epoch: of this process.
            batch_size: items in a batch; the data loader must use the same, and workers take turns batch by batch.
            seed: of order and augmentation.
            pool: episodes that are shuffled together.
            uses: how often each sample is prepared.
            rank: number of this process ...
            processes: ... of so many.
        """
        self._source, self._prepare = source, prepare
        self._epochs, self._batches_per_epoch, self._batch_size = epochs, batches_per_epoch, batch_size
        self._seed, self._pool, self._uses = seed, pool, uses
        self._rank, self._processes = rank, processes

    def __iter__(self) -> Iterator[Item]:
        info = get_worker_info()
        worker, workers = (info.id, info.num_workers) if info is not None else (0, 1)
        # The loader asks worker 0 first, wherever the run starts; in an uninterrupted run it might be another's turn.
        worker = (worker + self._epochs.start * self._batches_per_epoch) % workers
        for epoch in self._epochs:
            first = epoch * self._batches_per_epoch
            batches = sum(number % workers == worker for number in range(first, first + self._batches_per_epoch))
            yield from self._epoch(epoch, worker, workers, batches * self._batch_size)

    def _epoch(self, epoch: int, worker: int, workers: int, count: int) -> Iterator[Item]:
        random = np.random.default_rng([self._seed, _STREAM, epoch, self._rank, worker])
        episodes = self._episodes(epoch, worker, workers)
        pool: list[LabelledCloud] = []
        episode_size = 0
        for remaining in range(count, 0, -1):
            while len(pool) < remaining and len(pool) <= (self._pool - 1) * episode_size:
                new = next(episodes) * self._uses
                pool.extend(new)
                episode_size = len(new)
            chosen = int(random.integers(len(pool)))
            pool[chosen], pool[-1] = pool[-1], pool[chosen]
            yield self._prepare(pool.pop(), random)

    def _episodes(self, epoch: int, worker: int, workers: int) -> Iterator[list[LabelledCloud]]:
        """The episodes of one worker in one epoch: no other has the same, and other epochs have others."""
        # An epoch uses at most one episode for each of its samples, so this leaves room for all.
        index = epoch * self._batches_per_epoch * self._batch_size * self._processes
        index += self._rank * workers + worker
        empty = 0
        while empty < _MAX_EMPTY:
            samples = list(self._source.episode(index))
            index += workers * self._processes
            empty = 0 if samples else empty + 1
            if samples:
                yield samples
        raise ValueError(f"the source had no samples in {_MAX_EMPTY} episodes in a row")


class FixedStream(IterableDataset[Item], Generic[Item]):
    """The samples of some episodes in order, unchanged: for validation."""

    def __init__(
        self,
        source: EpisodeSource,
        prepare: Callable[[LabelledCloud, np.random.Generator], Item],
        episodes: range,
    ) -> None:
        """Nothing is made before the first sample is asked for.

        Args:
            source: gives the episodes.
            prepare: makes an item of a sample.
            episodes: which ones; workers take turns.
        """
        self._source, self._prepare, self._episodes = source, prepare, episodes

    def __iter__(self) -> Iterator[Item]:
        info = get_worker_info()
        worker, workers = (info.id, info.num_workers) if info is not None else (0, 1)
        for index in self._episodes[worker::workers]:
            random = np.random.default_rng([_STREAM, index])
            for sample in self._source.episode(index):
                yield self._prepare(sample, random)
