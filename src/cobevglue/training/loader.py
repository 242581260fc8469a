"""Data loader: worker processes send batches through pipes instead of shared memory (`/dev/shm`)."""

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
    """Iterate over batches of samples, in order.

    By default, torch transfers tensors between processes in shared memory. Containers have 64 MB of it by default, and
    a batch that does not fit is lost. Therefore batches are pickled in the worker.

    Args:
        samples: a torch data set, iterable or with `__getitem__`.
        batch_size: number of samples in a batch.
        workers: number of worker processes; 0 loads in this process.
        collate: makes a batch of a list of samples; picklable.
        prefetch: number of batches that each worker prepares in advance.
        pin_memory: call `pin_memory` of each batch, for transfer to a GPU.
    """
    loader = DataLoader(
        samples,
        batch_size=batch_size,
        num_workers=workers,
        collate_fn=partial(_pickled, collate) if workers else collate,
        prefetch_factor=prefetch if workers else None,
        generator=torch.Generator(),  # the loader draws a seed from it instead of torch's global one
    )
    for sent in loader:
        batch = pickle.loads(sent) if workers else sent
        yield batch.pin_memory() if pin_memory else batch


def _pickled(collate: Callable[[list[Any]], Any], samples: list[Any]) -> bytes:
    return pickle.dumps(collate(samples), protocol=pickle.HIGHEST_PROTOCOL)
