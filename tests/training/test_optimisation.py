"""The learning rate over the steps, weight decay where it belongs, and the mean of the weights."""

from __future__ import annotations

from typing import Literal

import pytest
import torch
from torch import nn

from cobevglue.training import OptimisationConfig
from cobevglue.training.optimisation import MeanWeights, autocast, learning_rate, make_optimizer

CONFIG = OptimisationConfig(learning_rate=1.0, start=0.1, warm_up=0.2, end=0.01)


@pytest.mark.parametrize(
    ("step", "rate"),
    [
        (0, 0.1),  # a tenth at first
        (10, 0.55),  # half way up
        (20, 1.0),  # the top after a fifth of the steps
        (99, 0.01),  # the last step
    ],
)
def test_the_rate_rises_and_falls(step: int, rate: float) -> None:
    assert learning_rate(step, 100, CONFIG) == pytest.approx(rate)


def test_the_rate_has_one_top() -> None:
    rates = [learning_rate(step, 100, CONFIG) for step in range(100)]
    assert rates == sorted(rates[:20]) + sorted(rates[20:], reverse=True)


@pytest.mark.parametrize("steps", [1, 2])
def test_short_runs_have_a_learning_rate(steps: int) -> None:
    assert all(0.0 < learning_rate(step, steps, CONFIG) <= 1.0 for step in range(steps))


@pytest.mark.parametrize(
    ("precision", "kind"),
    [
        ("auto", torch.float32),  # half precision is slow on most CPUs
        ("float32", torch.float32),
        ("bfloat16", torch.bfloat16),
    ],
)
def test_cpu_products_have_the_requested_precision(
    precision: Literal["auto", "float32", "bfloat16"], kind: torch.dtype
) -> None:
    with autocast(OptimisationConfig(precision=precision), torch.device("cpu")):
        assert nn.Linear(2, 2)(torch.ones(1, 2)).dtype == kind


def test_biases_and_norms_are_not_decayed() -> None:
    net = nn.Sequential(nn.Conv2d(1, 2, 1), nn.BatchNorm2d(2))
    decayed, free = make_optimizer(net, OptimisationConfig(weight_decay=0.1)).param_groups
    assert (decayed["weight_decay"], [p.ndim for p in decayed["params"]]) == (0.1, [4])
    assert (free["weight_decay"], [p.ndim for p in free["params"]]) == (0.0, [1, 1, 1])


def test_mean_weights_follow_at_their_pace() -> None:
    net = nn.Linear(1, 1, bias=False)
    nn.init.zeros_(net.weight)
    mean = MeanWeights(net, 0.9)
    nn.init.ones_(net.weight)
    mean.update(net, step=1000)
    assert mean.model.weight.item() == pytest.approx(0.1)
    mean.update(net, step=1000)
    assert mean.model.weight.item() == pytest.approx(0.19)
    assert net.weight.item() == 1.0


def test_early_steps_are_forgotten_fast() -> None:
    net = nn.Linear(1, 1, bias=False)
    nn.init.zeros_(net.weight)
    mean = MeanWeights(net, 0.999)
    nn.init.ones_(net.weight)
    mean.update(net, step=0)
    assert mean.model.weight.item() == pytest.approx(0.9)


def test_statistics_of_norms_follow_and_counters_are_copied() -> None:
    net = nn.BatchNorm1d(1)
    mean = MeanWeights(net, 0.5)
    net(torch.tensor([[2.0], [4.0]]))
    mean.update(net, step=1000)
    assert net.running_mean is not None
    assert mean.model.running_mean is not None
    assert mean.model.running_mean.item() == pytest.approx(net.running_mean.item() / 2)
    assert mean.model.num_batches_tracked == net.num_batches_tracked == 1
