"""Distributed training with `torchrun`; without it, one process trains and nothing is communicated."""

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
    """This process in the process group.

    Attributes:
        device: of this process.
        rank: index of this process, from 0.
        count: number of processes.
    """

    device: torch.device
    rank: int = 0
    count: int = 1

    @property
    def is_first(self) -> bool:
        """Whether this process writes files and reports progress."""
        return self.rank == 0

    def gather(self, value: Any) -> list[Any]:
        """Values of all processes by rank in the first process; an empty list in the others."""
        if self.count == 1:
            return [value]
        values = [None] * self.count if self.is_first else None
        dist.gather_object(value, values)
        return values or []

    def share(self, value: Any) -> Any:
        """Broadcast `value` of the first process to all."""
        if self.count == 1:
            return value
        values = [value]
        dist.broadcast_object_list(values)
        return values[0]


@contextmanager
def process_group(device: str) -> Iterator[Processes]:
    """Initialise the process group if `torchrun` started this process, and destroy it at the end.

    Args:
        device: "auto" (CUDA if available), or torch's name of a device.

    Raises:
        ValueError: the device is not available.
    """
    chosen = chosen_device(device)
    count = int(os.environ.get("WORLD_SIZE", "1"))
    if count == 1 or dist.is_initialized():
        rank = dist.get_rank() if dist.is_initialized() else 0
        yield Processes(chosen, rank, dist.get_world_size() if dist.is_initialized() else 1)
        return
    if chosen.type == "cuda":
        torch.cuda.set_device(chosen)
    # By default, Gloo (torch 2.13) connects all processes at once, and sometimes hangs there.
    os.environ.setdefault("TORCH_GLOO_LAZY_INIT", "1")
    dist.init_process_group("nccl" if chosen.type == "cuda" else "gloo")
    try:
        yield Processes(chosen, dist.get_rank(), dist.get_world_size())
    finally:
        dist.destroy_process_group()
