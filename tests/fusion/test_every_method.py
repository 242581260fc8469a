"""What is true of every method that learns, whatever it shares."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch

from cobevglue.fusion import FUSION_METHODS, IntermediateFusion
from cobevglue.fusion.rotation_conditioning import RotationConditioning
from cobevglue.fusion.where2comm import Where2comm
from cobevglue.perception import DetectionLoss, assign_targets, collate_targets

from . import checks

DETECTOR = checks.small_detector()
LEARNED = {name: kind for name, kind in FUSION_METHODS.items() if issubclass(kind, IntermediateFusion)}

every_method = pytest.mark.parametrize("name", LEARNED)


def made(name: str, seed: int = 1) -> IntermediateFusion:
    """With random weights everywhere, also where they are 0 or close to it before training."""
    method = checks.seeded(LEARNED[name], DETECTOR, seed)
    generator = torch.Generator().manual_seed(seed)
    with torch.no_grad():
        for parameter in method.parameters():
            parameter.add_(0.1 * torch.randn(parameter.shape, generator=generator))
    if isinstance(method, Where2comm):
        method.threshold = 0.0  # by default, an untrained head is not confident of anything
    return method


@every_method
def test_the_order_of_collaborators_does_not_matter(name: str) -> None:
    method = made(name)
    ego, *others = (checks.view(DETECTOR, seed) for seed in range(3))
    received = [checks.sent(method, other, pose) for other, pose in zip(others, checks.POSES, strict=True)]
    checks.assert_same_boxes(method.fuse(ego, received), method.fuse(ego, received[::-1]))


@every_method
def test_collaborators_matter(name: str) -> None:
    """Or the other tests would hold of a method that does not listen."""
    method = made(name)
    ego, other = checks.view(DETECTOR, 0), checks.view(DETECTOR, 1)
    alone, together = method.fuse(ego, []), method.fuse(ego, [checks.sent(method, other, checks.POSES[0])])
    assert len(alone)
    assert len(together)
    n = min(len(alone), len(together))
    assert len(alone) != len(together) or np.abs(alone.bev - together.bev)[:n].max() > 1e-3


@pytest.mark.parametrize("name", [n for n in LEARNED if n not in {"coalign", "fpv-rcnn", "cobevglue"}])
def test_agent_without_coverage_changes_nothing(name: str) -> None:
    """Except CoAlign's, whose attention counts empty cells, and methods that take over boxes from everywhere."""
    method = made(name)
    ego, near, far = (checks.view(DETECTOR, seed) for seed in range(3))
    heard = [checks.sent(method, near, checks.POSES[0])]
    unreached = checks.sent(method, far, checks.FAR)
    checks.assert_same_boxes(method.fuse(ego, [*heard, unreached]), method.fuse(ego, heard), atol=1e-5)


@every_method
def test_gradients_reach_every_weight(name: str) -> None:
    """Of a batch with a frame in which there is nobody but the ego."""
    method = made(name)
    samples = [
        checks.sample_of([checks.view(DETECTOR, 0), checks.view(DETECTOR, 1)]),
        checks.sample_of([checks.view(DETECTOR, 2)]),
    ]
    targets = []
    for sample in samples:
        assert sample.truth is not None
        rows = np.column_stack([sample.truth.center, sample.truth.size, sample.truth.yaw])
        targets.append(assign_targets(rows, np.zeros(len(rows), dtype=bool), method.anchors))
    batch, loss = collate_targets(targets, len(method.anchors)), DetectionLoss(method.config)
    method.train()
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(4)
        with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
            assert torch.isfinite(method.loss(samples, batch, loss)["total"])  # no precisions are mixed up
        terms = method.loss(samples, batch, loss)
    terms["total"].backward()  # type: ignore[no-untyped-call]
    assert all(torch.isfinite(term) for term in terms.values())
    idle = [name for name, p in method.named_parameters() if p.grad is None or not p.grad.abs().max() > 0]
    assert not idle
    assert all(p.grad is None for p in DETECTOR.parameters())


@every_method
def test_saved_weights_say_the_same(name: str, tmp_path: Path) -> None:
    method, another = made(name, 1), made(name, 2)
    ego, other = checks.view(DETECTOR, 0), checks.view(DETECTOR, 1)
    received = [checks.sent(method, other, checks.POSES[0])]
    method.save(tmp_path / "weights.safetensors")
    another.load(tmp_path / "weights.safetensors")
    checks.assert_same_boxes(another.fuse(ego, received), method.fuse(ego, received), atol=0.0)


@every_method
def test_before_training_features_are_not_turned(name: str) -> None:
    method = checks.seeded(LEARNED[name], DETECTOR)
    assert all(isinstance(turn, RotationConditioning) and not turn.last.weight.any() for turn in method.conditioning)
