"""The two attentions of V2X-ViT (Xu et al., ECCV 2022): over agents in every cell, and over the cells of a window.

Maps are (n, H, W, C) here, channels last.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

__all__ = ["AgentAttention", "MultiScaleWindowAttention", "WindowAttention"]


class AgentAttention(nn.Module):
    """Multi-agent self-attention, the paper's HMSA for agents of one type: each cell by itself.

    Args:
        channels: C.
        heads: of the attention; they share the channels.

    Raises:
        ValueError: the channels cannot be shared.
    """

    def __init__(self, channels: int, heads: int = 4) -> None:
        super().__init__()
        if channels % heads:
            raise ValueError(f"channels: {channels} is not a multiple of {heads} heads")
        self.heads = heads
        self.query = nn.Linear(channels, channels)
        self.key = nn.Linear(channels, channels, bias=False)  # one would add the same to all scores
        self.value, self.out = nn.Linear(channels, channels), nn.Linear(channels, channels)

    def forward(self, x: Tensor, present: Tensor, wanted: int) -> Tensor:
        """What the first agents make of all.

        Args:
            x: (n, H, W, C) of n agents.
            present: (n, H, W) whether the agent sees anything there; one that does not is not asked.
            wanted: how many agents' results are asked for.

        Returns:
            (wanted, H, W, C).
        """
        query, key, value = (
            values.unflatten(-1, (self.heads, -1)) for values in (self.query(x[:wanted]), self.key(x), self.value(x))
        )
        score = (query[:, None] * key).sum(dim=-1) / math.sqrt(query.shape[-1])  # (wanted, n, H, W, heads)
        weight = score.masked_fill(~present[..., None], -torch.inf).softmax(dim=1)
        mixed: Tensor = self.out((weight[..., None] * value).sum(dim=1).flatten(-2))
        return mixed


class MultiScaleWindowAttention(nn.Module):
    """Attention within windows of several sizes, merged: the paper's MSwin.

    The larger the window, the fewer the heads and the wider each of them, as in the paper; the sizes share the channels
    (in the paper each has as many as there are). Merged by split attention (Zhang et al., "ResNeSt", 2020): each
    channel of each agent is a mean over the sizes, with weights computed from the whole map.

    Args:
        channels: C.
        windows: sides of the windows [cells], ascending.
    """

    def __init__(self, channels: int, windows: Sequence[int]) -> None:
        super().__init__()
        heads = [2 ** (len(windows) - i) for i in range(len(windows))]
        self.branches = nn.ModuleList(
            WindowAttention(channels, window, h, max(channels // (len(windows) * h), 1))
            for window, h in zip(windows, heads, strict=True)
        )
        self.squeeze = nn.Sequential(nn.Linear(channels, channels), nn.LayerNorm(channels), nn.ReLU(inplace=True))
        self.split = nn.Linear(channels, len(windows) * channels)

    def forward(self, x: Tensor) -> Tensor:
        """(n, H, W, C) to the same shape."""
        branches = torch.stack([branch(x) for branch in self.branches])  # (sizes, n, H, W, C)
        whole = self.split(self.squeeze(branches.sum(dim=0).mean(dim=(1, 2))))  # (n, sizes * C)
        weight = whole.unflatten(-1, (len(branches), -1)).softmax(dim=1).transpose(0, 1)  # (sizes, n, C)
        merged: Tensor = (weight[:, :, None, None] * branches).sum(dim=0)
        return merged


class WindowAttention(nn.Module):
    """Self-attention among the cells of a window, which has learned how much each offset matters.

    Windows tile the map from the corner of its first cell; where they reach beyond the map, there are no keys.

    Args:
        channels: C.
        window: side of a window [cells].
        heads: of the attention.
        width: channels of each head.
    """

    index: Tensor

    def __init__(self, channels: int, window: int, heads: int, width: int) -> None:
        super().__init__()
        self.window, self.heads = window, heads
        self.inputs = nn.Linear(channels, 3 * heads * width)
        self.out = nn.Linear(heads * width, channels)
        self.bias = nn.Parameter(torch.empty(heads, (2 * window - 1) ** 2))
        nn.init.trunc_normal_(self.bias, std=0.02)
        row, column = torch.meshgrid(torch.arange(window), torch.arange(window), indexing="ij")
        row, column = row.flatten(), column.flatten()
        offset = (row[:, None] - row + window - 1) * (2 * window - 1) + column[:, None] - column + window - 1
        self.register_buffer("index", offset, persistent=False)  # (window^2, window^2) of query and key

    def forward(self, x: Tensor) -> Tensor:
        """(n, H, W, C) to the same shape."""
        n, height, width, _ = x.shape
        w = self.window
        rows, columns = -(-height // w), -(-width // w)
        beyond = 0, 0, 0, columns * w - width, 0, rows * w - height
        tokens = F.pad(self.inputs(x), beyond).view(n, rows, w, columns, w, 3, self.heads, -1)
        query, key, value = tokens.permute(5, 0, 1, 3, 6, 2, 4, 7).reshape(3, n * rows * columns, self.heads, w * w, -1)
        score_bias = self.bias[:, self.index]
        if any(beyond):
            outside = F.pad(x.new_zeros(height, width), beyond[2:], value=-torch.inf)
            outside = outside.view(rows, w, columns, w).transpose(1, 2).reshape(rows * columns, 1, 1, w * w)
            score_bias = (score_bias + outside).repeat(n, 1, 1, 1)
        mixed = F.scaled_dot_product_attention(query, key, value, attn_mask=score_bias)
        mixed = mixed.view(n, rows, columns, self.heads, w, w, -1).permute(0, 1, 4, 2, 5, 3, 6)
        mixed = mixed.reshape(n, rows * w, columns * w, -1)[:, :height, :width]
        out: Tensor = self.out(mixed)
        return out
