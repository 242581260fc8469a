"""CoAlign's fusion (Lu et al., ICRA 2023): attention over agents in every cell, at each of three scales.

Its other half, the agent-object pose graph that corrects the poses first, is the aligner "coalign".
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from torch import Tensor

from cobevglue.fusion.intermediate import MultiScaleFusion

__all__ = ["CoAlign", "ego_attention"]


class CoAlign(MultiScaleFusion):
    """Multi-scale intermediate fusion of the paper, without parameters.

    Cells that an agent's map does not reach are zeros, and take part as zeros: neither this paper nor OPV2V's (Xu et
    al., ICRA 2022), which the attention is from, leaves them out.
    """

    usual_aligner = "coalign"
    training_noise = (0.2, 0.2)

    def fuse_maps(self, maps: Sequence[Tensor], covered: Sequence[Tensor]) -> list[Tensor]:
        """The ego's row of the attention, in each map."""
        return [ego_attention(m) for m in maps]


def ego_attention(agents: Tensor) -> Tensor:
    """The ego's row of softmax(X X^T / sqrt(C)) X in every cell, X the features of n agents there.

    Scaled dot-product self-attention without projections (the attentive fusion of OPV2V, Xu et al., ICRA 2022).

    Args:
        agents: (n, C, H, W), the ego first.

    Returns:
        (C, H, W).
    """
    score = (agents[:1] * agents).sum(dim=1, keepdim=True) / math.sqrt(agents.shape[1])
    return (score.softmax(dim=0) * agents).sum(dim=0)
