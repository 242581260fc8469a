"""From a point cloud to a pseudo-image: a feature vector for each vertical column that has points.

After Lang et al., "PointPillars" (CVPR 2019), section 2.1, with the dynamic grouping of Zhou et al. (CoRL 2019): all
points count and all pillars, there are no caps and no padding.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from cobevglue.perception.config import PointPillarsConfig

__all__ = ["PillarEncoder", "batch_clouds"]


def batch_clouds(clouds: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Several clouds (N_i, 4) as one: (M, 4) points, and (M,) which cloud each is from."""
    counts = torch.tensor([len(cloud) for cloud in clouds], device=clouds[0].device)
    return torch.cat(list(clouds)), torch.repeat_interleave(counts)


class PillarEncoder(nn.Module):
    """Describes each point within its pillar, lifts that by a linear layer, and takes the maximum over the pillar.

    A point is described by where it is (x, y, z), its offsets from the mean of its pillar's points (3) and from the
    pillar's centre (3), each scaled to about -1..1, and its intensity where the settings say so.
    """

    low: Tensor
    high: Tensor

    def __init__(self, config: PointPillarsConfig) -> None:
        super().__init__()
        self.config = config
        ranges = torch.tensor([config.x_range, config.y_range, config.z_range], dtype=torch.float32)
        self.register_buffer("low", ranges[:, 0].contiguous(), persistent=False)
        self.register_buffer("high", ranges[:, 1].contiguous(), persistent=False)
        self.linear = nn.Linear(9 + config.use_intensity, config.pillar_channels, bias=False)
        self.norm = nn.BatchNorm1d(config.pillar_channels, eps=1e-3, momentum=0.01)

    def forward(self, points: Tensor, cloud: Tensor, clouds: int) -> Tensor:
        """The pseudo-image of `clouds` clouds.

        Args:
            points: (M, 4) x, y, z [m], intensity, of all clouds. Points out of range, or with a coordinate
                that is not finite, are dropped; an intensity that is not finite counts as 0.
            cloud: (M,) integers, the cloud that each point is from.
            clouds: how many there are, B; any may be empty.

        Returns:
            (B, C, rows, columns), laid out channels-last; rows are y and columns x, both from min to max. Pillars
            without points are 0.
        """
        # In bfloat16 a point at 100 m would be off by half a metre.
        with torch.autocast(points.device.type, enabled=False):
            return self._forward(points.float(), cloud, clouds)

    def _forward(self, points: Tensor, cloud: Tensor, clouds: int) -> Tensor:
        rows, columns, channels = self.config.rows, self.config.columns, self.config.pillar_channels
        xy = (points[:, :2] - self.low[:2]) / self.config.pillar
        z = points[:, 2]
        inside = (
            torch.isfinite(points[:, :3]).all(dim=1) & (xy >= 0).all(dim=1) & (xy[:, 0] < columns) & (xy[:, 1] < rows)
        )
        inside &= (z >= self.low[2]) & (z < self.high[2])
        points, xy, cloud = points[inside], xy[inside].floor(), cloud[inside]
        pillar = (cloud * rows + xy[:, 1].long()) * columns + xy[:, 0].long()

        features = (
            self.norm(self.linear(self._describe(points, xy, pillar, clouds)))
            if len(points)
            else points.new_zeros(0, channels)
        )
        canvas: Tensor = _ScatterMax.apply(features, pillar, clouds * rows * columns)  # type: ignore[no-untyped-call]
        return canvas.view(clouds, rows, columns, channels).permute(0, 3, 1, 2)

    def _describe(self, points: Tensor, cell: Tensor, pillar: Tensor, clouds: int) -> Tensor:
        """(M, 9 or 10) what the network is told of each point."""
        size = torch.cat([points.new_full((2,), self.config.pillar), (self.high - self.low)[2:]])
        center = torch.cat(
            [self.low[:2] + (cell + 0.5) * size[:2], ((self.low + self.high) / 2)[2:].expand(len(cell), 1)], 1
        )
        xyz = points[:, :3]
        from_center = xyz - center
        # Sums of offsets, not of coordinates: those would lose digits.
        sums = points.new_zeros(clouds * self.config.rows * self.config.columns, 4)
        sums.index_add_(0, pillar, torch.cat([from_center, torch.ones_like(xyz[:, :1])], 1))
        mean = sums[pillar]
        from_mean = from_center - mean[:, :3] / mean[:, 3:]
        parts = [
            (xyz - (self.low + self.high) / 2) / (self.high - self.low) * 2,
            from_mean / size * 2,
            from_center / size * 2,
        ]
        if self.config.use_intensity:
            parts.append(points[:, 3:4].nan_to_num(0.0, 0.0, 0.0))
        return torch.cat(parts, 1)


class _ScatterMax(torch.autograd.Function):
    """Maximum of 0 and all rows that go to the same place: ReLU and pooling in one.

    PyTorch's own `scatter_reduce` takes ten times longer back than forth on a CPU, since it shares the gradient evenly
    among equals. Here each gets it in full; equals are points at the same place.
    """

    @staticmethod
    def forward(ctx: Any, rows: Tensor, index: Tensor, size: int) -> Tensor:
        """(M, C) rows to (size, C)."""
        out = rows.new_zeros(size, rows.shape[1])
        out.scatter_reduce_(0, index[:, None].expand_as(rows), rows, "amax", include_self=True)
        ctx.save_for_backward(rows, index, out)
        return out

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor, None, None]:
        """To the rows that won; to none where 0 did."""
        rows, index, out = ctx.saved_tensors
        won = (rows == out[index]) & (rows > 0)
        return grads[0][index] * won, None, None
