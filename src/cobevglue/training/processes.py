"""One or many processes: `torchrun` starts many; without it there is one, and nothing here does anything."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import torch
import torch.distributed as dist

from cobevglue.torch_device import chosen_device

__all__ = ["Processes", "process_group"]


@dataclass(frozen=True)
class Processes:
    """This process among all.

    Attributes:
        device: what this process computes on.
        rank: its number, from 0.
        count: how many there are.
    """

    device: torch.device
    rank: int = 0
    count: int = 1

    @property
    def is_first(self) -> bool:
        """Whether this is the process that writes and reports."""
        return self.rank == 0

    def gather(self, value: Any) -> list[Any]:
        """`value` of every process in the order of ranks, in the first process; an empty list in the others."""
        if self.count == 1:
            return [value]
        values = [None] * self.count if self.is_first else None
        dist.gather_object(value, values)
        return values or []

    def share(self, value: Any) -> Any:
        """`value` of the first process."""
        if self.count == 1:
            return value
        values = [value]
        dist.broadcast_object_list(values)
        return values[0]


@contextmanager
def process_group(device: str) -> Iterator[Processes]:
    """Join the processes that `torchrun` started, if it did.

    Args:
        device: "auto" (CUDA where there is one), or torch's name of a device.

    Raises:
        ValueError: there is no such device.
    """
    chosen = chosen_device(device)
    count = int(os.environ.get("WORLD_SIZE", "1"))
    if count == 1 or dist.is_initialized():
        rank = dist.get_rank() if dist.is_initialized() else 0
        yield Processes(chosen, rank, dist.get_world_size() if dist.is_initialized() else 1)
        return
    if chosen.type == "cuda":
        torch.cuda.set_device(chosen)
    # Gloo (torch 2.13) otherwise connects all processes at once, and now and then hangs in that.
    os.environ.setdefault("TORCH_GLOO_LAZY_INIT", "1")
    dist.init_process_group("nccl" if chosen.type == "cuda" else "gloo")
    try:
        yield Processes(chosen, dist.get_rank(), dist.get_world_size())
    finally:
        dist.destroy_process_group()
