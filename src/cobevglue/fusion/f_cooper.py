"""F-Cooper (Chen et al., SEC 2019), as benchmarks run it: the maximum over agents of one map."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from cobevglue.fusion.intermediate import SingleMapFusion

__all__ = ["FCooper"]


class FCooper(SingleMapFusion):
    """Spatial feature fusion of the paper (section 3.3): element-wise maximum of the agents' maps at stride 2."""

    def fuse_maps(self, maps: Sequence[Tensor], covered: Sequence[Tensor]) -> list[Tensor]:
        """The maximum over agents."""
        return [maps[0].amax(dim=0)]
