"""The data loader of all trainings: worker processes send batches through pipes, not through `/dev/shm`."""

from __future__ import annotations

import pickle
from collections.abc import Callable, Iterator
from functools import partial
from typing import Any

import torch
from torch.utils.data import DataLoader

__all__ = ["batches"]


def batches(
    samples: Any,
    batch_size: int,
    workers: int,
    collate: Callable[[list[Any]], Any],
    prefetch: int = 2,
    pin_memory: bool = False,
) -> Iterator[Any]:
    """Batches of samples, in order.

    torch's own way between processes is shared memory, of which containers have 64 MB by default; there a batch is lost
    with a message from a thread. So a batch is pickled in the worker.

    Args:
        samples: a torch data set, iterable or with `__getitem__`.
        batch_size: samples in a batch.
        workers: processes that make batches; 0 makes them in this one.
        collate: makes a batch of a list of samples; picklable.
        prefetch: batches that each worker makes in advance.
        pin_memory: call `pin_memory` of each batch, for transfer to a GPU.
    """
    loader = DataLoader(
        samples,
        batch_size=batch_size,
        num_workers=workers,
        collate_fn=partial(_pickled, collate) if workers else collate,
        prefetch_factor=prefetch if workers else None,
        generator=torch.Generator(),  # the loader draws a seed; not from the caller's generator
    )
    for sent in loader:
        batch = pickle.loads(sent) if workers else sent
        yield batch.pin_memory() if pin_memory else batch


def _pickled(collate: Callable[[list[Any]], Any], samples: list[Any]) -> bytes:
    return pickle.dumps(collate(samples), protocol=pickle.HIGHEST_PROTOCOL)
