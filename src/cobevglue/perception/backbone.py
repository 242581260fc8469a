"""Convolutional backbone (feature maps at strides 2, 4 and 8) and neck (one map at stride 2).

Residual blocks as in CoAlign (Lu et al., ICRA 2023), whose multi-scale fusion is applied between backbone and neck; the
neck is that of SECOND (Yan et al., Sensors 2018) and PointPillars.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from cobevglue.perception.config import STRIDES, PointPillarsConfig

__all__ = ["Backbone", "Neck", "conv_norm"]


def conv_norm(inputs: int, outputs: int, kernel: int, stride: int = 1, relu: bool = True) -> nn.Sequential:
    """Convolution without bias, batch normalisation, optional ReLU."""
    layers: list[nn.Module] = [
        nn.Conv2d(inputs, outputs, kernel, stride, padding=kernel // 2, bias=False),
        nn.BatchNorm2d(outputs, eps=1e-3, momentum=0.01),
    ]
    return nn.Sequential(*layers, nn.ReLU(inplace=True)) if relu else nn.Sequential(*layers)


class ResidualBlock(nn.Module):
    """Two 3 x 3 convolutions with a shortcut (He et al., CVPR 2016)."""

    def __init__(self, inputs: int, outputs: int, stride: int) -> None:
        super().__init__()
        self.first = conv_norm(inputs, outputs, 3, stride)
        self.second = conv_norm(outputs, outputs, 3, relu=False)
        same = stride == 1 and inputs == outputs
        self.shortcut = nn.Identity() if same else conv_norm(inputs, outputs, 1, stride, relu=False)

    def forward(self, x: Tensor) -> Tensor:
        """(B, inputs, H, W) to (B, outputs, H / stride, W / stride)."""
        return torch.relu(self.second(self.first(x)) + self.shortcut(x))


class Backbone(nn.Module):
    """Three stages of residual blocks, each at half the resolution of the previous one."""

    def __init__(self, config: PointPillarsConfig) -> None:
        super().__init__()
        self.stages = nn.ModuleList()
        inputs = config.pillar_channels
        for layers, channels in zip(config.block_layers, config.block_channels, strict=True):
            blocks = [ResidualBlock(inputs, channels, 2)]
            blocks += [ResidualBlock(channels, channels, 1) for _ in range(layers - 1)]
            self.stages.append(nn.Sequential(*blocks))
            inputs = channels

    def forward(self, image: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """The pseudo-image (B, C, H, W) to maps (B, C_i, H / s, W / s) at strides s = 2, 4, 8."""
        first = self.stages[0](image)
        second = self.stages[1](first)
        return first, second, self.stages[2](second)


class Neck(nn.Module):
    """Upsample the three maps to stride 2, concatenate them, and reduce the channels to the input of the head."""

    def __init__(self, config: PointPillarsConfig) -> None:
        super().__init__()
        self.ups = nn.ModuleList()
        for stride, channels in zip(STRIDES, config.block_channels, strict=True):
            scale = stride // STRIDES[0]
            up = nn.ConvTranspose2d(channels, config.up_channels, scale, scale, bias=False)
            norm = nn.BatchNorm2d(config.up_channels, eps=1e-3, momentum=0.01)
            self.ups.append(nn.Sequential(up, norm, nn.ReLU(inplace=True)))
        self.shrink = nn.Sequential(
            conv_norm(len(STRIDES) * config.up_channels, config.shrink_channels, config.shrink_kernel),
            conv_norm(config.shrink_channels, config.shrink_channels, 3),
        )

    def forward(self, maps: Sequence[Tensor]) -> Tensor:
        """Maps at strides 2, 4, 8 to (B, shrink_channels, H / 2, W / 2)."""
        ups = [up(x) for up, x in zip(self.ups, maps, strict=True)]
        shrunk: Tensor = self.shrink(torch.cat(ups, dim=1))
        return shrunk
