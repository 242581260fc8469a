"""Which device torch computes on."""

from __future__ import annotations

import os

import torch

__all__ = ["chosen_device"]


def chosen_device(device: str = "auto") -> torch.device:
    """The device of this name; under `torchrun`, CUDA is each process's own.

    Args:
        device: "auto" (CUDA where there is one), or torch's name of a device.

    Raises:
        ValueError: there is no such device.
    """
    name = ("cuda" if torch.cuda.is_available() else "cpu") if device == "auto" else device
    if name == "cuda" and int(os.environ.get("WORLD_SIZE", "1")) > 1:
        name = f"cuda:{int(os.environ['LOCAL_RANK'])}"
    try:
        return torch.zeros(1, device=name).device
    except (RuntimeError, AssertionError, NotImplementedError) as error:
        first_line = (str(error) or type(error).__name__).splitlines()[0]
        raise ValueError(f"device {device!r} cannot be used: {first_line}") from None
