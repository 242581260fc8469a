"""Streams of training and validation samples, distributed over processes and their workers."""

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
"""Separates these random numbers from others of the same seed."""
_MAX_EMPTY = 100
"""Maximum number of consecutive episodes without samples."""


class EpisodeStream(IterableDataset[Item], Generic[Item]):
    """Training samples of several epochs for one process.

    The samples of an epoch, their order and their augmentation depend only on the seed, the epoch and the numbers of
    processes and workers. A resumed run therefore gets the same samples as an uninterrupted one.

    Samples of one episode are similar, so a worker draws at random from the samples of several episodes. Workers
    continue with the next epoch while the process validates.
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
        """Store the settings; no sample is computed before iteration.

        Args:
            source: of the episodes.
            prepare: preprocesses a sample: augmentation, targets.
            epochs: indices of the epochs, in steps of 1.
            batches_per_epoch: of this process.
            batch_size: items in a batch; the data loader must use the same, with workers alternating by batch.
            seed: of order and augmentation.
            pool: number of episodes that are shuffled together.
            uses: number of times that each sample is used.
            rank: index of this process.
            processes: number of processes.
        """
        self._source, self._prepare = source, prepare
        self._epochs, self._batches_per_epoch, self._batch_size = epochs, batches_per_epoch, batch_size
        self._seed, self._pool, self._uses = seed, pool, uses
        self._rank, self._processes = rank, processes

    def __iter__(self) -> Iterator[Item]:
        info = get_worker_info()
        worker, workers = (info.id, info.num_workers) if info is not None else (0, 1)
        # The loader always starts with worker 0; in an uninterrupted run, another worker might make this batch.
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
        """The episodes of one worker in one epoch, disjoint from those of other workers, processes and epochs."""
        # An epoch uses at most one episode per sample, so the indices of epochs do not overlap.
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
    """The samples of some episodes in fixed order, for validation."""

    def __init__(
        self,
        source: EpisodeSource,
        prepare: Callable[[LabelledCloud, np.random.Generator], Item],
        episodes: range,
    ) -> None:
        """Store the settings; no sample is computed before iteration.

        Args:
            source: of the episodes.
            prepare: preprocesses a sample.
            episodes: indices of the episodes; distributed over the workers.
        """
        self._source, self._prepare, self._episodes = source, prepare, episodes

    def __iter__(self) -> Iterator[Item]:
        info = get_worker_info()
        worker, workers = (info.id, info.num_workers) if info is not None else (0, 1)
        for index in self._episodes[worker::workers]:
            random = np.random.default_rng([_STREAM, index])
            for sample in self._source.episode(index):
                yield self._prepare(sample, random)
