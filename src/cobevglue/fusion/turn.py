"""What an agent's features say of directions, said in the ego's directions.

A detector's features tell which way things face, and that in the frame of the agent whose points they are of. Warping
takes a feature to where it belongs and leaves what it says: a car that faces along the other's x axis still does, also
where the other drives across the ego's road. Networks that are trained end to end have to live with that; on a frozen
encoder it costs more than collaboration gains (`docs/collaboration.md` has the figures). As the angle between the two
is known, a feature can be told it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

__all__ = ["Turn"]

_HARMONICS = 2
"""Sines and cosines of the angle, and of twice the angle: boxes are nearly the same after half a turn."""


class Turn(nn.Module):
    """Adds to a map what changes with the angle. It is our addition to all methods that share maps.

    A layer whose weights are trigonometric polynomials of the angle, a ReLU, and a convolution; at first it adds 0. The
    ego's own map goes through it, too, at angle 0: so a frozen encoder's features can become ones that are fit to be
    put together.

    Args:
        channels: C of the maps.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.weights = nn.Parameter(torch.empty(1 + 2 * _HARMONICS, channels, channels))
        nn.init.normal_(self.weights, std=1.0 / math.sqrt(channels * (1 + _HARMONICS)))
        self.last = nn.Conv2d(channels, channels, 3, padding=1)
        nn.init.zeros_(self.last.weight)
        if self.last.bias is not None:
            nn.init.zeros_(self.last.bias)

    def forward(self, maps: Tensor, yaws: Sequence[float], covered: Tensor) -> Tensor:
        """The same maps in the ego's directions.

        Args:
            maps: (B, C, H, W) of B agents, warped.
            yaws: B headings of these agents in the ego's frame [rad].
            covered: (B, 1, H, W) 0 where an agent's map does not reach; it stays 0 there.

        Returns:
            (B, C, H, W), not negative.
        """
        if not len(maps):
            return maps
        told = torch.cat([self._told(one[None], yaw) for one, yaw in zip(maps, yaws, strict=True)])
        turned: Tensor = torch.relu(maps + self.last(torch.relu(told)))
        return turned * (covered > 0)

    def _told(self, maps: Tensor, yaw: float) -> Tensor:
        basis = [1.0]
        for harmonic in range(1, _HARMONICS + 1):
            basis += [math.cos(harmonic * yaw), math.sin(harmonic * yaw)]
        weight = torch.einsum("k,koi->oi", self.weights.new_tensor(basis), self.weights)
        return F.conv2d(maps, weight[:, :, None, None])
