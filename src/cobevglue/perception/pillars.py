"""Pillar encoder: from a point cloud to a pseudo-image with a feature vector for each non-empty pillar.

After Lang et al., "PointPillars" (CVPR 2019), section 2.1, with the dynamic voxelisation of Zhou et al. (CoRL 2019): no
limits on the numbers of points and pillars, and no padding.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor, nn

from cobevglue.perception.config import PointPillarsConfig

__all__ = ["PillarEncoder", "batch_clouds"]


def batch_clouds(clouds: Sequence[Tensor]) -> tuple[Tensor, Tensor]:
    """Concatenate clouds (N_i, 4) to (M, 4) points, with the (M,) cloud index of each."""
    counts = torch.tensor([len(cloud) for cloud in clouds], device=clouds[0].device)
    return torch.cat(list(clouds)), torch.repeat_interleave(counts)


class PillarEncoder(nn.Module):
    """Linear layer on the features of each point, and maximum over each pillar.

    The features of a point are its coordinates (3), its offsets from the mean of its pillar's points (3) and from the
    pillar's centre (3), each scaled to about -1..1, and its intensity if `use_intensity` is set.
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
        """Compute the pseudo-image of B clouds.

        Args:
            points: (M, 4) x, y, z [m], intensity, of all clouds. Points out of range or with non-finite coordinates
                are dropped; a non-finite intensity is replaced by 0.
            cloud: (M,) cloud index of each point.
            clouds: B, the number of clouds; any may be empty.

        Returns:
            (B, C, rows, columns) in channels-last memory format; rows along y and columns along x, both from min to
            max. Empty pillars are 0.
        """
        # In bfloat16 the rounding error at 100 m would be half a metre.
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
            self.norm(self.linear(self._point_features(points, xy, pillar, clouds)))
            if len(points)
            else points.new_zeros(0, channels)
        )
        canvas: Tensor = _ScatterMax.apply(features, pillar, clouds * rows * columns)  # type: ignore[no-untyped-call]
        return canvas.view(clouds, rows, columns, channels).permute(0, 3, 1, 2)

    def _point_features(self, points: Tensor, cell: Tensor, pillar: Tensor, clouds: int) -> Tensor:
        """(M, 9 or 10) features of each point."""
        size = torch.cat([points.new_full((2,), self.config.pillar), (self.high - self.low)[2:]])
        center = torch.cat(
            [self.low[:2] + (cell + 0.5) * size[:2], ((self.low + self.high) / 2)[2:].expand(len(cell), 1)], 1
        )
        xyz = points[:, :3]
        from_center = xyz - center
        # Sums of offsets instead of coordinates, for precision.
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
    """Maximum of 0 and all rows with the same index: ReLU and max pooling in one.

    The backward pass of PyTorch's `scatter_reduce` takes ten times longer than the forward pass on a CPU, since it
    divides the gradient evenly among ties. Here each gets it in full; ties are points at the same position.
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
        """Gradient of the rows that are the maximum; 0 for all others."""
        rows, index, out = ctx.saved_tensors
        is_maximum = (rows == out[index]) & (rows > 0)
        return grads[0][index] * is_maximum, None, None
