"""Where2comm (Hu et al., NeurIPS 2022): agents share the cells where they are confident of an object, and no others.

This is the paper's first round of communication, in which an agent broadcasts one message. Later rounds, in which it
requests cells where it is not confident, need messages in both directions and are not implemented.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cobevglue.fusion.intermediate import SingleMapFusion, _half
from cobevglue.messages import Arrays
from cobevglue.perception import PerceptionOutput, PointPillars
from cobevglue.se2 import SE2

__all__ = ["ConfidenceAttention", "Where2comm", "smoothed"]

_WAVELENGTHS = (8.0, 24.0, 72.0, 216.0)
"""Of the positional encoding of distances to a sensor [m]."""
_FEWEST = 1e-3
"""Minimum share of cells that an agent sends in training."""
_SMALLEST = 1e-6
"""Lower limit of the confidence, so that its logarithm is finite."""


class Where2comm(SingleMapFusion):
    """The map at stride 2, where the sender's own head is confident.

    Confidence is the head's best score in a cell, on the sender's own map ("spatial confidence generator"). Smoothed by
    a Gaussian, which keeps some context around an object, it decides what is sent: all cells above a threshold, or in
    training a random share of the cells, so that any threshold may be taken afterwards. The share is log-uniform from
    0.1 % to all, drawn from torch's generator (that distribution is ours). The ego's own map is never masked.

    A message is the numbers of the selected cells and their features. The confidence itself need not be sent: head and
    features are known where they arrive.

    Attributes:
        threshold: smoothed confidence from which on a cell is sent; 0 sends all. The 0.01 of the authors' code is what
            a head trained with the focal loss predicts for empty road: two thirds of all cells would be sent.
    """

    shares_maps = False
    threshold: float = 0.05
    distance: Tensor

    def __init__(self, detector: PointPillars) -> None:
        super().__init__(detector)
        self.attention = ConfidenceAttention(self.config.shrink_channels)
        rows, columns, _ = self.config.head_shape
        x = np.linspace(*self.config.x_range, 2 * columns + 1)[1::2]
        y = np.linspace(*self.config.y_range, 2 * rows + 1)[1::2]
        distance = torch.from_numpy(np.hypot(x[None, :], y[:, None]).astype(np.float32))
        self.register_buffer("distance", distance[None, None], persistent=False)

    def share(self, features: Sequence[Tensor]) -> list[Tensor]:
        """The neck's map, its confidence (B, 1, H, W), and 1 where a cell is selected, 0 elsewhere (B, 1, H, W)."""
        (shared,) = super().share(features)
        confidence = self.cell_confidence(shared)
        return [shared, confidence, self._selected(confidence.detach())]

    def cell_confidence(self, shared: Tensor) -> Tensor:
        """(B, 1, H, W) best score of any anchor in each cell of the neck's map (B, C, H, W)."""
        logits: Tensor = self.head.logits(shared)
        return logits.amax(dim=1, keepdim=True).sigmoid()

    def _selected(self, confidence: Tensor) -> Tensor:
        smooth = smoothed(confidence)
        if not self.training:
            return (smooth >= self.threshold).to(smooth)
        agents = len(smooth)
        fraction = _FEWEST ** torch.rand(agents, 1, device=smooth.device)
        rank = smooth.flatten(1).argsort(dim=1, descending=True).argsort(dim=1)
        return (rank < fraction * rank.shape[1]).to(smooth).view_as(smooth)

    def _fuse(
        self, maps: Sequence[Tensor], ego_SE2_agent: Sequence[SE2], sent: Sequence[Tensor] | None = None
    ) -> list[Tensor]:
        shared, confidence, selected = maps
        selected = torch.cat([torch.ones_like(selected[:1]), selected[1:]])
        distance = self.distance.expand_as(selected)
        return super()._fuse([shared * selected, confidence * selected, selected, distance], ego_SE2_agent)

    def fuse_maps(self, maps: Sequence[Tensor], covered: Sequence[Tensor]) -> list[Tensor]:
        """Attention over the agents that sent something of a cell.

        Args:
            maps: features, confidence, selection, and distance to the sensor, as warped.
            covered: not looked at: a cell that is out of reach was not sent.
        """
        features, confidence, selected, distance = maps
        fused: Tensor = self.attention(features, confidence, selected > 0, distance)
        return [fused]

    @torch.inference_mode()
    def message(self, observation: PerceptionOutput) -> Arrays:
        """The K selected cells: numbers (K,), row by row, uint16 where that suffices; features (K, C) in float16."""
        shared, _, selected = self.share([m[None] for m in observation.features])
        cells = selected.flatten().nonzero()[:, 0]
        features = shared[0].flatten(1)[:, cells].T
        kind = np.uint16 if selected.numel() <= 1 << 16 else np.uint32
        return {"cells": cells.cpu().numpy().astype(kind), "features": _half(features)}

    def received_maps(self, content: Arrays) -> list[Tensor]:
        """The maps that `share` has made, 0 in all cells that were not sent.

        Raises:
            ValueError: cells outside the map, or not as many as there are features.
        """
        rows, columns, _ = self.config.head_shape
        channels, count = self.config.shrink_channels, rows * columns
        cells, features = content["cells"].astype(np.int64), content["features"].astype(np.float32)
        if features.shape != (len(cells), channels) or (cells >= count).any():
            raise ValueError(
                f"message: {features.shape} features for cells up to {cells.max(initial=0)}; this detector's map has "
                f"{count} cells of {channels} channels"
            )
        device = self.distance.device
        shared, selected = torch.zeros(channels, count, device=device), torch.zeros(1, count, device=device)
        shared[:, cells] = torch.from_numpy(features.T).to(device)
        selected[:, cells] = 1.0
        shared, selected = shared.view(channels, rows, columns), selected.view(1, rows, columns)
        return [shared, self.cell_confidence(shared[None])[0] * selected, selected]


class ConfidenceAttention(nn.Module):
    """The paper's message fusion: in every cell, attention of the ego to the agents, then an FFN.

    An agent's weight is its scaled dot product with the ego's query times its confidence. Distances to the sensors are
    inputs of query and key (the paper's sensor positional encoding). One head. Two things are ours, so that the decoder
    may start as the single agent's: weights are divided by their sum after the multiplication with the confidence, and
    the FFN is residual. A cell that no other agent sent stays nearly unchanged.

    Args:
        channels: C of the maps.
    """

    def __init__(self, channels: int) -> None:
        super().__init__()
        inputs = channels + 2 * len(_WAVELENGTHS)
        self.query = nn.Conv2d(inputs, channels, 1)
        self.key = nn.Conv2d(inputs, channels, 1, bias=False)  # a bias would add the same to all scores
        last = nn.Conv2d(2 * channels, channels, 1)
        nn.init.normal_(last.weight, std=0.001)
        if last.bias is not None:
            nn.init.zeros_(last.bias)
        self.feed_forward = nn.Sequential(nn.Conv2d(channels, 2 * channels, 1), nn.ReLU(inplace=True), last)

    def forward(self, features: Tensor, confidence: Tensor, present: Tensor, distance: Tensor) -> Tensor:
        """The ego's fused map.

        Args:
            features: (n, C, H, W) of n agents, the ego first.
            confidence: (n, 1, H, W) 0 to 1.
            present: (n, 1, H, W) whether the agent sent the cell; true everywhere for the ego.
            distance: (n, 1, H, W) to the agent's sensor [m].

        Returns:
            (C, H, W).
        """
        weight = self.weights(features, confidence, present, distance)
        mixed = (weight * features).sum(dim=0, keepdim=True)
        fused: Tensor = mixed + self.feed_forward(mixed)
        return fused[0]

    def weights(self, features: Tensor, confidence: Tensor, present: Tensor, distance: Tensor) -> Tensor:
        """(n, 1, H, W) attention weights of the agents in each cell, which sum to 1. See `forward`."""
        inputs = torch.cat([features, _sinusoids(distance)], dim=1)
        score: Tensor = (self.query(inputs[:1]) * self.key(inputs)).sum(dim=1, keepdim=True)
        score = score / math.sqrt(features.shape[1]) + confidence.clamp(min=_SMALLEST).log()
        return score.masked_fill(~present, -torch.inf).softmax(dim=0)


def _sinusoids(distance: Tensor) -> Tensor:
    """(n, 2 per wavelength, H, W) of distances (n, 1, H, W)."""
    angle = torch.cat([distance * (2.0 * math.pi / wavelength) for wavelength in _WAVELENGTHS], dim=1)
    return torch.cat([angle.sin(), angle.cos()], dim=1)


def smoothed(values: Tensor) -> Tensor:
    """(B, 1, H, W) averaged by a Gaussian of one cell's deviation over 5 x 5 cells; 0 beyond the border."""
    line = torch.exp(-0.5 * torch.arange(-2.0, 3.0, device=values.device, dtype=values.dtype) ** 2)
    line = line / line.sum()
    kernel = line[:, None] * line[None, :]
    return F.conv2d(values, kernel[None, None], padding=2)
