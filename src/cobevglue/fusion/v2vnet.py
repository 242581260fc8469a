"""V2VNet (Wang et al., ECCV 2020): agents exchange messages, and each updates its map with those received."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import torch
from torch import Tensor, nn

from cobevglue.fusion.coarse_map import CoarseMapFusion
from cobevglue.perception import PointPillars

__all__ = ["V2VNet"]


class V2VNet(CoarseMapFusion):
    """Cross-vehicle aggregation by a graph neural network (section 3.2 of the paper).

    Every agent is a node, its map is the node's state. In each round every node gets a message from every node, itself
    included: a convolution of both states, 0 where the sender's map does not reach. The maximum over the messages goes
    into a gated recurrent unit whose hidden state is the node's map. After the last round, a linear layer in each
    cell.

    It differs from the paper in that all states are in the ego's frame from the start, as only the ego's is decoded in
    the end; the paper warps them to the receiver's frame in every round. What a convolution does to the border of a map
    apart, that is the same. And as convolution is linear, that of two states is the sum of one of each, which takes n
    convolutions of n agents in place of n x n. Ours are the sizes: messages have half as many channels as states, and
    the receiver's half of the convolution and the recurrent unit see one cell only. Delays are not compensated.

    Attributes:
        rounds: how often messages are passed.
    """

    rounds: ClassVar[int] = 2

    def __init__(self, detector: PointPillars) -> None:
        super().__init__(detector)
        wide, narrow = self.channels, self.channels // 2
        self.sender = nn.Conv2d(wide, narrow, 3, padding=1)
        self.receiver = nn.Conv2d(wide, narrow, 1, bias=False)
        self.update = GatedUpdate(wide, narrow)
        self.last = nn.Sequential(nn.Conv2d(wide, wide, 1), nn.ReLU(inplace=True))

    def fuse_maps(self, maps: Sequence[Tensor], covered: Sequence[Tensor]) -> list[Tensor]:
        """The ego's state after all rounds of messages."""
        return [self.pass_messages(maps[0], covered[0])]

    def pass_messages(self, states: Tensor, weight: Tensor) -> Tensor:
        """The ego's state after all rounds.

        Args:
            states: (n, C, H, W) of n agents at first, all in the ego's frame, the ego first.
            weight: (n, 1, H, W) weight of the messages of each agent.

        Returns:
            (C, H, W).
        """
        for remaining in reversed(range(self.rounds)):
            receivers = states if remaining else states[:1]  # the ego's is the last state that is of use
            sent, own = self.sender(states), self.receiver(receivers)
            aggregated = torch.stack([(torch.relu(sent + one) * weight).amax(dim=0) for one in own])
            states = self.update(receivers, aggregated)
        last: Tensor = self.last(states)[0]
        return last


class GatedUpdate(nn.Module):
    """A gated recurrent unit in each cell (Ballas et al., ICLR 2016, with kernels of 1 x 1)."""

    def __init__(self, states: int, inputs: int) -> None:
        super().__init__()
        self.gates = nn.Conv2d(states + inputs, 2 * states, 1)
        self.candidate = nn.Conv2d(states + inputs, states, 1)

    def forward(self, state: Tensor, message: Tensor) -> Tensor:
        """The new state (B, states, H, W): between the old one and a candidate made of it and the message."""
        gates: Tensor = self.gates(torch.cat([state, message], dim=1)).sigmoid()
        change, keep = gates.chunk(2, dim=1)
        candidate: Tensor = self.candidate(torch.cat([keep * state, message], dim=1)).tanh()
        return state + change * (candidate - state)
