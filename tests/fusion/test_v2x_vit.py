"""V2X-ViT: its attentions against loops, and what is true of the whole."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import nn

from cobevglue.fusion import fusion_class
from cobevglue.fusion.v2x_vit import V2XViT, V2XViTBlock
from cobevglue.fusion.v2x_vit_attention import AgentAttention, MultiScaleWindowAttention, WindowAttention
from cobevglue.typing import FloatArray

from . import checks

DETECTOR = checks.small_detector()


def made(kind: type[nn.Module], *arguments: object) -> nn.Module:
    """A module in double precision, the same each time."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        module = kind(*arguments).double()
        for parameter in module.parameters():
            nn.init.normal_(parameter, std=0.5)
    return module


def random_map(*shape: int, seed: int = 0) -> FloatArray:
    return np.random.default_rng(seed).normal(size=shape)


def weights_of(module: nn.Module) -> dict[str, FloatArray]:
    return {name: value.detach().numpy() for name, value in module.named_parameters()}


def softmax(values: FloatArray) -> FloatArray:
    raw = np.exp(values - values.max())
    weights: FloatArray = raw / raw.sum()
    return weights


@pytest.mark.parametrize("size", [(4, 8), (5, 7), (3, 2)])  # of whole windows, reaching beyond both sides, in one
def test_window_attention_equals_loop_over_cells(size: tuple[int, int]) -> None:
    height, width = size
    w, heads, channels = 4, 2, 3
    module = made(WindowAttention, 5, w, heads, channels)
    x = random_map(2, height, width, 5)
    p = weights_of(module)
    bias = p["bias"].reshape(heads, 2 * w - 1, 2 * w - 1)
    tokens = (x @ p["inputs.weight"].T + p["inputs.bias"]).reshape(2, height, width, 3, heads, channels)
    mixed = np.zeros((2, height, width, heads, channels))
    for n, r, c, h in np.ndindex(2, height, width, heads):
        window = [
            (i, j)
            for i in range(r // w * w, min(r // w * w + w, height))
            for j in range(c // w * w, min(c // w * w + w, width))
        ]
        query = tokens[n, r, c, 0, h]
        scores = [
            tokens[n, i, j, 1, h] @ query / math.sqrt(channels) + bias[h, r - i + w - 1, c - j + w - 1]
            for i, j in window
        ]
        values = np.array([tokens[n, i, j, 2, h] for i, j in window])
        mixed[n, r, c, h] = softmax(np.array(scores)) @ values
    expected = mixed.reshape(2, height, width, -1) @ p["out.weight"].T + p["out.bias"]
    np.testing.assert_allclose(module(torch.from_numpy(x)).detach().numpy(), expected, atol=1e-10)


def test_agent_attention_equals_loop_over_cells() -> None:
    module = made(AgentAttention, 6, 2)
    x = random_map(3, 2, 2, 6)
    present = np.ones((3, 2, 2), dtype=bool)
    present[1, 0, 1] = present[2, 1, :] = False
    p = weights_of(module)
    query, key, value = (
        (x @ p[f"{name}.weight"].T + p.get(f"{name}.bias", 0.0)).reshape(3, 2, 2, 2, 3)
        for name in ("query", "key", "value")
    )
    mixed = np.zeros((3, 2, 2, 2, 3))
    for i, r, c, h in np.ndindex(3, 2, 2, 2):
        others = np.flatnonzero(present[:, r, c])
        weight = softmax(np.array([query[i, r, c, h] @ key[j, r, c, h] / math.sqrt(3) for j in others]))
        mixed[i, r, c, h] = weight @ value[others, r, c, h]
    expected = mixed.reshape(3, 2, 2, 6) @ p["out.weight"].T + p["out.bias"]
    found = module(torch.from_numpy(x), torch.from_numpy(present), 3).detach().numpy()
    np.testing.assert_allclose(found, expected, atol=1e-10)


def test_compatible_sizes_are_merged() -> None:
    module = made(MultiScaleWindowAttention, 8, (2, 3))
    assert isinstance(module, MultiScaleWindowAttention)
    module.branches[1] = module.branches[0]
    x = torch.from_numpy(random_map(2, 5, 4, 8))
    torch.testing.assert_close(module(x), module.branches[0](x))


def test_merging_weighs_each_channel_by_the_whole_map() -> None:
    module = made(MultiScaleWindowAttention, 8, (2, 3))
    assert isinstance(module, MultiScaleWindowAttention)
    x = torch.from_numpy(random_map(1, 5, 4, 8))
    a, b = (branch(x) for branch in module.branches)
    share = (module(x) - b) / (a - b)
    torch.testing.assert_close(share, share[:, :1, :1].expand_as(share), atol=1e-6, rtol=1e-6)
    assert (share > 0).all()
    assert (share < 1).all()


def test_a_window_never_looks_over_its_border() -> None:
    module = made(WindowAttention, 5, 4, 2, 3)
    x = torch.from_numpy(random_map(1, 8, 8, 5))
    changed = x.clone()
    changed[:, :4, :4] += 1.0
    same = torch.isclose(module(x), module(changed)).all(dim=-1)[0]
    assert not same[:4, :4].any()
    assert same[4:].all()
    assert same[:, 4:].all()


def test_asking_for_the_ego_alone_gives_the_same() -> None:
    block = made(V2XViTBlock, 8, (2, 4))
    x, present = torch.from_numpy(random_map(3, 6, 5, 8)), torch.ones(3, 6, 5, dtype=torch.bool)
    torch.testing.assert_close(block(x, present, 1), block(x, present, 3)[:1])


def test_channels_that_heads_cannot_share_are_refused() -> None:
    with pytest.raises(ValueError, match="channels: 6"):
        AgentAttention(6, heads=4)


def test_it_is_used_as_its_paper_does() -> None:
    assert fusion_class("v2x-vit") is V2XViT
    assert V2XViT.training_noise == (0.2, 0.2)
