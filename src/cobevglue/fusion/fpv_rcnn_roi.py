"""FPV-RCNN's second stage: scores and refines each proposal from the keypoints of all agents in it."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

__all__ = ["RoIHead"]

_CHANNELS = 32
_HIDDEN = 128
_SCORE_LIMIT = 1e-4
_HARMONICS = 2
"""Sines and cosines of an angle, and of twice the angle, as in `RotationConditioning`."""


class RoIHead(nn.Module):
    """RoI grid pooling and fully connected layers (as in PV-RCNN, Shi et al., CVPR 2020).

    A proposal is divided into cells along its own axes. The feature of a cell is the maximum, over the keypoints in it,
    of a small network of their features and positions. PV-RCNN pools around each grid point within two radii, so that a
    keypoint is used several times; here it is used in its own cell only, for speed on CPUs.

    Features encode directions in the frame of their agent, a proposal is processed in its own axes: so the weights of
    the features are trigonometric polynomials of the angle between the two (ours, see `RotationConditioning`).

    Scores are predicted as offsets to those of the proposals, which are 0 before training.

    Args:
        features: F, of a keypoint.
        margin: enlargement of a proposal on every side [m].
        grid: cells along length, width and height.
    """

    def __init__(self, features: int, margin: float, grid: tuple[int, int, int] = (6, 4, 2)) -> None:
        super().__init__()
        self.margin, self.grid = margin, grid
        self.place = nn.Linear(6, _CHANNELS)
        self.feature = nn.Linear(features, (1 + 2 * _HARMONICS) * _CHANNELS, bias=False)
        self.point = nn.Sequential(nn.ReLU(inplace=True), nn.Linear(_CHANNELS, _CHANNELS), nn.ReLU(inplace=True))
        self.box = nn.Sequential(
            nn.Linear(math.prod(grid) * _CHANNELS + 5, _HIDDEN),
            nn.ReLU(inplace=True),
            nn.Linear(_HIDDEN, _HIDDEN),
            nn.ReLU(inplace=True),
        )
        self.logit, self.refinement = nn.Linear(_HIDDEN, 1), nn.Linear(_HIDDEN, 7)
        for layer in (self.logit, self.refinement):
            nn.init.normal_(layer.weight, std=0.001)
            nn.init.zeros_(layer.bias)

    def forward(
        self, boxes: Tensor, score: Tensor, count: Tensor, keypoints: Tensor, headings: Tensor, features: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Score and refine R proposals.

        Args:
            boxes: (R, 7) x, y, z, l, w, h [m], yaw [rad].
            score: (R,) of the proposals, 0 to 1.
            count: (R,) number of proposals merged into each.
            keypoints: (K, 3) x, y, z [m] in the same frame, of all agents.
            headings: (K,) heading of the agent of each keypoint [rad].
            features: (K, F) of the keypoints.

        Returns:
            (R,) logits of being an object, and (R, 7) refinements as `decode_refinement` takes them.
        """
        prior = torch.logit(score, eps=_SCORE_LIMIT)
        known = torch.cat([boxes[:, 3:6].log(), prior[:, None], count[:, None].log()], dim=1)
        x = self.box(torch.cat([self.pool(boxes, keypoints, headings, features).flatten(1), known], dim=1))
        return prior + self.logit(x)[:, 0], self.refinement(x)

    def pool(self, boxes: Tensor, keypoints: Tensor, headings: Tensor, features: Tensor) -> Tensor:
        """(R, cells, channels) pooled keypoint features of every cell of every proposal; 0 in empty cells.

        See `forward` for the arguments.
        """
        offset = keypoints - boxes[:, None, :3]  # (R, K, 3)
        c, s = boxes[:, None, 6].cos(), boxes[:, None, 6].sin()
        x, y, z = offset.unbind(dim=-1)
        local = torch.stack([c * x + s * y, c * y - s * x, z], dim=-1)
        share = local / (boxes[:, None, 3:6] + 2.0 * self.margin) + 0.5  # 0 to 1 inside
        inside = ((share >= 0.0) & (share < 1.0)).all(dim=-1)
        box, keypoint = inside.nonzero(as_tuple=True)
        share, local = share[inside], local[inside]

        grid = torch.tensor(self.grid, device=boxes.device)
        i, j, k = (share * grid).long().unbind(dim=-1)
        cells = math.prod(self.grid)
        cell = box * cells + (i * self.grid[1] + j) * self.grid[2] + k
        angle = boxes[box, 6] - headings[keypoint]
        waves = [wave(n * angle) for n in range(1, 1 + _HARMONICS) for wave in (torch.cos, torch.sin)]
        weight = torch.stack([torch.ones_like(angle), *waves], dim=1)
        rotated = self.feature(features).unflatten(1, (-1, _CHANNELS))[keypoint]  # (pairs, waves, channels)
        rotated = (weight[:, :, None] * rotated).sum(dim=1)
        encoded: Tensor = self.point(rotated + self.place(torch.cat([local, share - 0.5], dim=1)))
        pooled = encoded.new_zeros(len(boxes) * cells, encoded.shape[1])
        pooled = pooled.scatter_reduce(0, cell[:, None].expand_as(encoded), encoded, "amax")
        return pooled.view(len(boxes), cells, _CHANNELS)
