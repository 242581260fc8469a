"""V2VNet's rounds of messages, against the same written pair by pair."""

from __future__ import annotations

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from cobevglue.fusion import FUSION_METHODS
from cobevglue.fusion.v2vnet import GatedUpdate, V2VNet

from . import checks

DETECTOR = checks.small_detector()


def make_method(seed: int = 1) -> V2VNet:
    method = checks.seeded(V2VNet, DETECTOR, seed)
    method.up.weight.data.mul_(500.0)  # at first they are close to 0
    return method


def pair_by_pair(method: V2VNet, states: list[Tensor], weight: Tensor) -> Tensor:
    """The paper's algorithm as it is written: all pairs, all agents, one convolution of both maps for each message."""
    centre = F.pad(method.receiver.weight, (1, 1, 1, 1))
    kernel = torch.cat([method.sender.weight, centre], dim=1)
    for _ in range(method.rounds):
        new = []
        for receiver in states:
            messages = []
            for sender, mask in zip(states, weight, strict=True):
                both = torch.cat([sender, receiver])[None]
                messages.append(torch.relu(F.conv2d(both, kernel, method.sender.bias, padding=1)) * mask)
            heard = torch.stack(messages).amax(dim=0)
            new.append(method.update(receiver[None], heard)[0])
        states = new
    result: Tensor = method.last(states[0][None])[0]
    return result


@pytest.mark.parametrize("agents", [1, 2, 4])
def test_messages_are_those_of_all_pairs(agents: int) -> None:
    method = make_method()
    states = torch.rand(agents, 16, 8, 16)
    weight = torch.rand(agents, 1, 8, 16).round()
    weight[0] = 1.0
    expected = pair_by_pair(method, list(states), weight)
    torch.testing.assert_close(method.pass_messages(states, weight), expected, rtol=1e-4, atol=1e-5)


def test_gru_update_lies_between_state_and_candidate() -> None:
    torch.manual_seed(0)
    update = GatedUpdate(4, 2)
    state, heard = 3.0 * torch.randn(2, 4, 5, 6), torch.randn(2, 2, 5, 6)
    new = update(state, heard)
    assert (new <= state.clamp(min=1.0)).all()  # a candidate is in [-1, 1]
    assert (new >= state.clamp(max=-1.0)).all()
    assert not torch.allclose(new, state)
    with torch.no_grad():
        assert update.gates.bias is not None
        update.gates.bias.fill_(-1e4)
    assert torch.equal(update(state, heard), state)


def test_it_goes_by_the_name_that_users_type() -> None:
    assert FUSION_METHODS["v2vnet"] is V2VNet
