"""Detection head: objectness, box residuals, direction and variance of every anchor."""

from __future__ import annotations

import math
from typing import NamedTuple

from torch import Tensor, nn

from cobevglue.perception.config import PointPillarsConfig

__all__ = ["Head", "HeadOutput"]

_PRIOR = 0.01
"""Initial probability of an object, so that the loss of the background does not dominate the first steps (Lin et al.,
"Focal Loss", ICCV 2017, section 3.3)."""


class HeadOutput(NamedTuple):
    """Raw output for B clouds, in float32, of N anchors in the order rows (y), columns (x), anchors of a cell.

    `output.logits.view(B, *config.head_shape)` is a map.

    Attributes:
        logits: (B, N) objectness.
        residuals: (B, N, 7) from the anchor to the box; see `AnchorGrid`.
        direction: (B, N, 2) logits: facing along the anchor, or against it.
        log_variance: (B, N, 3) natural logarithm of the variance of x and y [m^2] and yaw [rad^2].
    """

    logits: Tensor
    residuals: Tensor
    direction: Tensor
    log_variance: Tensor


class Head(nn.Module):
    """Four 1 x 1 convolutions."""

    def __init__(self, config: PointPillarsConfig) -> None:
        super().__init__()
        anchors = config.head_shape[2]
        self.logits = nn.Conv2d(config.shrink_channels, anchors, 1)
        self.residuals = nn.Conv2d(config.shrink_channels, anchors * 7, 1)
        self.direction = nn.Conv2d(config.shrink_channels, anchors * 2, 1)
        self.log_variance = nn.Conv2d(config.shrink_channels, anchors * 3, 1)
        assert self.logits.bias is not None
        nn.init.constant_(self.logits.bias, -math.log((1 - _PRIOR) / _PRIOR))
        nn.init.normal_(self.logits.weight, std=0.01)
        for conv in (self.residuals, self.direction, self.log_variance):
            assert conv.bias is not None
            nn.init.zeros_(conv.bias)
            nn.init.normal_(conv.weight, std=0.001)

    def forward(self, x: Tensor) -> HeadOutput:
        """Feature map (B, C, H, W) to the output of B x N anchors."""

        def per_anchor(values: Tensor, number: int) -> Tensor:
            # Free where the map is laid out channels-last.
            return values.permute(0, 2, 3, 1).reshape(values.shape[0], -1, number).float()

        return HeadOutput(
            per_anchor(self.logits(x), 1)[..., 0],
            per_anchor(self.residuals(x), 7),
            per_anchor(self.direction(x), 2),
            per_anchor(self.log_variance(x), 3),
        )
