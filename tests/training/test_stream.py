"""The stream of samples: a function of seed, epoch, process and worker, wherever it is entered."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import pytest
from torch.utils.data import DataLoader

from cobevglue import Boxes
from cobevglue.datasets.labelled_cloud import LabelledCloud
from cobevglue.training.stream import EpisodeStream, FixedStream


@dataclass(frozen=True)
class Numbers:
    """Episode i has `size` samples of one point at x = i, y = number of the sample."""

    size: int = 3

    def episode(self, index: int) -> Sequence[LabelledCloud]:
        points = [np.array([[index, j, 0, 0]], dtype=np.float32) for j in range(self.size)]
        return [LabelledCloud(p, Boxes.empty(), np.zeros(0, dtype=np.int64)) for p in points]


def tell(sample: LabelledCloud, random: np.random.Generator) -> tuple[int, int, float]:
    """Episode, number, and a random number as augmentation would draw one."""
    return int(sample.points[0, 0]), int(sample.points[0, 1]), float(random.random())


Batches = list[list[tuple[int, int, float]]]


def read(
    first: int, last: int, workers: int, per_epoch: int = 5, rank: int = 0, processes: int = 1, uses: int = 1
) -> Batches:
    """The batches of two items of epochs first ... last - 1."""
    stream = EpisodeStream(
        Numbers(),
        tell,
        epochs=range(first, last),
        batches_per_epoch=per_epoch,
        batch_size=2,
        seed=4,
        pool=2,
        uses=uses,
        rank=rank,
        processes=processes,
    )
    return list(DataLoader(stream, batch_size=2, num_workers=workers, collate_fn=list))


@pytest.mark.filterwarnings("ignore:This DataLoader will create:UserWarning")  # more workers than cores
@pytest.mark.parametrize("workers", [0, 2, 3])
def test_entering_at_an_epoch_continues_the_whole(workers: int) -> None:
    """Five batches do not divide among two or three workers: the next epoch starts with another worker's turn."""
    whole = read(0, 3, workers)
    assert len(whole) == 15
    assert read(1, 3, workers) == whole[5:]
    assert read(2, 3, workers) == whole[10:]


def test_reading_twice_gives_the_same() -> None:
    assert read(0, 2, 2) == read(0, 2, 2)


def test_epochs_differ() -> None:
    whole = read(0, 2, 0)
    assert whole[:5] != whole[5:]


@pytest.mark.parametrize(("workers", "processes"), [(0, 1), (2, 1), (0, 3), (2, 2)])
def test_no_sample_comes_twice(workers: int, processes: int) -> None:
    parts = [read(0, 2, workers, rank=rank, processes=processes) for rank in range(processes)]
    samples = [(episode, number) for part in parts for batch in part for episode, number, _ in batch]
    assert len(samples) == len(set(samples)) == 2 * 5 * 2 * processes


def test_samples_are_reused_with_different_augmentation() -> None:
    """24 items are two uses of twelve samples, which is four episodes: no fifth is made."""
    items = [item for batch in read(0, 1, 0, per_epoch=12, uses=2) for item in batch]
    samples = [item[:2] for item in items]
    assert {sample: samples.count(sample) for sample in samples} == {(e, n): 2 for e in range(4) for n in range(3)}
    assert len({drawn for *_, drawn in items}) == 24


def test_samples_of_several_episodes_are_shuffled_together() -> None:
    order = [(episode, number) for batch in read(0, 1, 0, per_epoch=20) for episode, number, _ in batch]
    assert order != sorted(order)
    assert len({episode for episode, _ in order[:6]}) > 2  # not one episode after the other


def test_source_without_samples_raises() -> None:
    stream = EpisodeStream(Numbers(0), tell, epochs=range(1), batches_per_epoch=1, batch_size=1, seed=0, pool=2)
    with pytest.raises(ValueError, match="no samples in 100 episodes"):
        next(iter(stream))


@pytest.mark.parametrize("workers", [0, 2])
def test_validation_has_each_sample_once(workers: int) -> None:
    stream = FixedStream(Numbers(), tell, range(1, 6, 2))
    batches = list(DataLoader(stream, batch_size=2, num_workers=workers, collate_fn=list))
    found = sorted((episode, number) for batch in batches for episode, number, _ in batch)
    assert found == [(episode, number) for episode in (1, 3, 5) for number in range(3)]
