"""V2X-ViT (Xu et al., "V2X-ViT: Vehicle-to-Everything Cooperative Perception with Vision Transformer", ECCV 2022).

Sized for a CPU: two blocks of the paper's three, fewer channels, windows of 4 and 8 cells without those of 16, which
take as long as all the rest. Omitted, because the inputs do not have the information:

- Agent types. The fusion methods do not receive whether an agent is a roadside unit. With one type, the heterogeneous
  attention's matrices for each pair of types are products with those of key and value, so that only these remain.
- Delay-aware positional encoding, and the correction for the motion of a delayed agent: all clouds of a frame have the
  same time stamp.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from cobevglue.fusion.coarse_map import CoarseMapFusion
from cobevglue.fusion.v2x_vit_attention import AgentAttention, MultiScaleWindowAttention
from cobevglue.perception import PointPillars

__all__ = ["V2XViT", "V2XViTBlock"]

_BLOCKS = 2
_WINDOWS = (4, 8)
"""Sides of the windows [cells]; a cell is 1.6 m with the compact detector, as in the paper."""


class V2XViT(CoarseMapFusion):
    """A transformer over agents and places, on a map at stride 4."""

    training_noise = (0.2, 0.2)

    def __init__(self, detector: PointPillars) -> None:
        super().__init__(detector)
        self.blocks = nn.ModuleList(V2XViTBlock(self.channels, _WINDOWS) for _ in range(_BLOCKS))
        self.to(memory_format=torch.channels_last)  # type: ignore[call-overload]

    def fuse_maps(self, maps: Sequence[Tensor], covered: Sequence[Tensor]) -> list[Tensor]:
        """The ego's map at stride 4 after all blocks."""
        x = maps[0].permute(0, 2, 3, 1)
        present = covered[0][:, 0] > 0
        for number, block in enumerate(self.blocks, start=1):
            x = block(x, present, len(x) if number < _BLOCKS else 1)
        return [x[0].permute(2, 0, 1)]


class V2XViTBlock(nn.Module):
    """Attention over agents, attention over places, and a feed-forward network, each after a norm and added.

    What the paper alternates in its encoder.

    Args:
        channels: C.
        windows: sides of the windows [cells].
    """

    def __init__(self, channels: int, windows: Sequence[int]) -> None:
        super().__init__()
        self.norms = nn.ModuleList(nn.LayerNorm(channels) for _ in range(3))
        self.agents = AgentAttention(channels)
        self.places = MultiScaleWindowAttention(channels, windows)
        self.feed_forward = nn.Sequential(nn.Linear(channels, channels), nn.GELU(), nn.Linear(channels, channels))

    def forward(self, x: Tensor, present: Tensor, wanted: int) -> Tensor:
        """What the first agents make of all.

        Args:
            x: (n, H, W, C) of n agents.
            present: (n, H, W) whether the agent sees anything there; of some agent in every cell.
            wanted: how many agents' results are asked for.

        Returns:
            (wanted, H, W, C).
        """
        x = x[:wanted] + self.agents(self.norms[0](x), present, wanted)
        x = x + self.places(self.norms[1](x))
        added: Tensor = x + self.feed_forward(self.norms[2](x))
        return added
