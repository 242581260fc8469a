"""CoAlign's fusion is scaled dot-product attention of the ego to all agents, in every cell of every map."""

from __future__ import annotations

import math

import numpy as np
import torch

from cobevglue.fusion import fusion_class
from cobevglue.fusion.coalign import CoAlign, ego_attention

from . import checks


def test_attention_equals_the_formula() -> None:
    x = np.random.default_rng(0).normal(size=(3, 5, 2, 4))
    expected = np.zeros((5, 2, 4))
    for row in range(2):
        for column in range(4):
            features = x[:, :, row, column]
            score = np.exp(features @ features.T / math.sqrt(5))
            expected[:, row, column] = ((score / score.sum(axis=1, keepdims=True)) @ features)[0]
    np.testing.assert_allclose(ego_attention(torch.from_numpy(x)).numpy(), expected, atol=1e-12)


def test_agents_that_agree_change_nothing() -> None:
    x = torch.randn(1, 6, 3, 3, generator=torch.Generator().manual_seed(0))
    torch.testing.assert_close(ego_attention(x.expand(4, -1, -1, -1)), x[0])


def test_uncovered_cells_take_part_as_zeros() -> None:
    ego = torch.tensor([1.0, 2.0]).view(1, 2, 1, 1)
    weight = math.exp(5.0 / math.sqrt(2.0))
    fused = ego_attention(torch.cat([ego, torch.zeros_like(ego)]))
    torch.testing.assert_close(fused, ego[0] * weight / (weight + 1.0))


def test_alone_it_is_the_detector() -> None:
    detector = checks.small_detector()
    seen = checks.view(detector, 0)
    checks.assert_same_boxes(CoAlign(detector).eval().fuse(seen, []), seen.detections)


def test_it_is_used_as_its_paper_does() -> None:
    assert fusion_class("coalign") is CoAlign
    assert CoAlign.usual_aligner == "coalign"
    assert CoAlign.training_noise == (0.2, 0.2)
