"""Rotation-conditioned features: an agent's feature map adapted to its heading in the ego's frame.

A detector's features encode headings in the frame of the agent whose points they come from. Warping moves a feature to
its position in the ego's frame but does not change what it encodes: a car along the other agent's x axis still appears
so, also where the other agent drives across the ego's road. Networks trained end to end have to cope with that; with a
frozen encoder it costs more than collaboration gains (`docs/collaboration.md` has the figures). The angle between the
two agents is known, so the features are conditioned on it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

__all__ = ["RotationConditioning"]

_HARMONICS = 2
"""Sines and cosines of the angle, and of twice the angle: boxes are nearly the same after half a turn."""


class RotationConditioning(nn.Module):
    """A residual layer on feature maps, conditioned on the rotation; our addition to all methods that share maps.

    A 1 x 1 convolution whose weights are trigonometric polynomials of the angle, a ReLU, and a 3 x 3 convolution that
    is initialised with 0. The ego's own map passes through it, too, at angle 0, which adapts a frozen encoder's
    features to fusion.

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
        """The maps, adapted to the rotation.

        Args:
            maps: (B, C, H, W) of B agents, warped.
            yaws: B headings of these agents in the ego's frame [rad].
            covered: (B, 1, H, W) 0 where an agent's map does not reach; it stays 0 there.

        Returns:
            (B, C, H, W), not negative.
        """
        if not len(maps):
            return maps
        conditioned = torch.cat([self._conditioned(one[None], yaw) for one, yaw in zip(maps, yaws, strict=True)])
        turned: Tensor = torch.relu(maps + self.last(torch.relu(conditioned)))
        return turned * (covered > 0)

    def _conditioned(self, maps: Tensor, yaw: float) -> Tensor:
        basis = [1.0]
        for harmonic in range(1, _HARMONICS + 1):
            basis += [math.cos(harmonic * yaw), math.sin(harmonic * yaw)]
        weight = torch.einsum("k,koi->oi", self.weights.new_tensor(basis), self.weights)
        return F.conv2d(maps, weight[:, :, None, None])
