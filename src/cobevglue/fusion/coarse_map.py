"""What V2VNet and V2X-ViT have in common: a map at stride 4 is shared, what comes of it is added to the ego's own."""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from cobevglue.fusion.intermediate import IntermediateFusion
from cobevglue.messages import Arrays
from cobevglue.perception import PerceptionOutput, PointPillars
from cobevglue.perception.head import HeadOutput
from cobevglue.se2 import SE2

__all__ = ["CoarseMapFusion"]


class CoarseMapFusion(IntermediateFusion):
    """Shares a map at stride 4, with twice the channels of the neck's; subclasses say how such maps are fused.

    In the papers the head reads the fused map. Ours works at stride 2, where the ego has its own map: the fused one is
    brought back to stride 2 and added to it. (Without the ego's map there, training for minutes on a CPU ended far
    below all other methods.) At first the method is the detector.

    Both changes of scale are by windows of 2 x 2 cells: a cell's centre stays where warping takes it to be.
    """

    def __init__(self, detector: PointPillars) -> None:
        super().__init__(detector)
        narrow = self.config.shrink_channels
        self.channels = 2 * narrow
        self.down = nn.Sequential(nn.Conv2d(narrow, self.channels, 2, 2), nn.ReLU(inplace=True))
        self.up = nn.ConvTranspose2d(self.channels, narrow, 2, 2, bias=False)
        nn.init.normal_(self.up.weight, std=0.001)

    def conditioned_channels(self) -> Sequence[int]:
        """Of the map at stride 4."""
        return [2 * self.config.shrink_channels]

    def share(self, features: Sequence[Tensor]) -> list[Tensor]:
        """The neck's map at stride 4, which is sent, and at stride 2, which is not."""
        own = self.neck(features)
        return [self.down(own), own]

    @torch.inference_mode()
    def message(self, observation: PerceptionOutput) -> Arrays:
        """The map at stride 4 (C, H, W) in float16."""
        return {"map0": super().message(observation)["map0"]}

    def received_maps(self, content: Arrays) -> list[Tensor]:
        """The map at stride 4, and zeros for the one that was not sent."""
        (shared,) = super().received_maps(content)
        rows, columns, _ = self.config.head_shape
        return [shared, shared.new_zeros(self.config.shrink_channels, rows, columns)]

    def _fuse(
        self, maps: Sequence[Tensor], ego_SE2_agent: Sequence[SE2], sent: Sequence[Tensor] | None = None
    ) -> list[Tensor]:
        return [*super()._fuse(maps[:1], ego_SE2_agent, sent), maps[1][0]]

    def decode_maps(self, maps: Sequence[Tensor]) -> HeadOutput:
        """The fused map back to stride 2, added to the ego's own there, and the head."""
        output: HeadOutput = self.head(torch.relu(maps[1] + self.up(maps[0])))
        return output
