"""A small detector, what it sees, and what is true of every fusion method."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import torch

from cobevglue import Boxes
from cobevglue.fusion import FusionSample, IntermediateFusion, Received
from cobevglue.fusion.turn import Turn
from cobevglue.messages import decode_arrays, encode_arrays
from cobevglue.perception import (
    DetectionLoss,
    Perception,
    PerceptionOutput,
    PointPillars,
    PointPillarsConfig,
    assign_targets,
    collate_targets,
)
from cobevglue.se2 import SE2
from cobevglue.typing import Float32Array

Method = TypeVar("Method", bound=IntermediateFusion)

SMALL = PointPillarsConfig(
    x_range=(-12.8, 12.8), y_range=(-6.4, 6.4), pillar_channels=8, block_layers=(1, 1, 1), block_channels=(8, 8, 12),
    up_channels=8, shrink_channels=8,
)  # fmt: skip
FAR = SE2(1000.0, 0.0, 0.3)
"""From here no map reaches the ego."""
POSES = SE2(3.0, 1.0, 0.2), SE2(-4.0, -1.5, 2.5)


def small_detector(seed: int = 0) -> PointPillars:
    """With random weights whose features and scores differ from place to place."""
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(seed)
        detector = PointPillars(SMALL)
        torch.nn.init.normal_(detector.head.logits.weight, std=0.5)
    norms = [m for m in detector.modules() if isinstance(m, torch.nn.BatchNorm1d | torch.nn.BatchNorm2d)]
    for norm in norms:
        norm.momentum = 1.0
    with torch.no_grad():
        detector.train()([torch.from_numpy(cloud(seed)) for seed in range(4)])
    for norm in norms:
        norm.momentum = 0.01
    detector.detection = detector.detection.model_copy(update={"score_threshold": 0.0, "max_detections": 20})
    return detector.eval()


def seeded(kind: type[Method], detector: PointPillars, seed: int = 1) -> Method:
    """A method with random weights, in evaluation mode."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return kind(detector).eval()


def cloud(seed: int, count: int = 600) -> Float32Array:
    """(N, 4) points everywhere."""
    rng = np.random.default_rng(seed)
    return rng.uniform([-12, -6, -2, 0], [12, 6, 0, 1], (count, 4)).astype(np.float32)


def view(detector: PointPillars, seed: int, count: int = 600) -> PerceptionOutput:
    """What an agent sees of random points."""
    return Perception(detector).step(cloud(seed, count))


def sample_of(seen: Sequence[PerceptionOutput], poses: Sequence[SE2] = POSES) -> FusionSample:
    """A frame whose objects are some of what the ego detects."""
    at = [SE2(), *poses[: len(seen) - 1]]
    truth = seen[0].detections[:4].replace(score=None, label=None)
    return FusionSample(seen, at, at, truth=truth)


def sent(method: IntermediateFusion, seen: PerceptionOutput, pose: SE2) -> Received:
    """A message that went over the wire."""
    return Received(decode_arrays(encode_arrays(method.message(seen))), pose)


def assert_same_boxes(a: Boxes, b: Boxes, atol: float = 1e-4) -> None:
    assert len(a) == len(b) > 0
    assert a.score is not None
    assert b.score is not None
    np.testing.assert_allclose(a.bev, b.bev, atol=atol)
    np.testing.assert_allclose(a.score, b.score, atol=atol)


def check_order_of_collaborators(method: IntermediateFusion, detector: PointPillars) -> None:
    """It does not matter who is listened to first."""
    ego, *others = (view(detector, seed) for seed in range(3))
    received = [sent(method, other, pose) for other, pose in zip(others, POSES, strict=True)]
    there, back = method.fuse(ego, received), method.fuse(ego, received[::-1])
    assert_same_boxes(there, back)


def check_collaborators_matter(method: IntermediateFusion, detector: PointPillars) -> None:
    """What is received changes the result: or the other checks would hold of a method that does not listen."""
    ego, other = view(detector, 0), view(detector, 1)
    alone, together = method.fuse(ego, []), method.fuse(ego, [sent(method, other, POSES[0])])
    assert len(alone)
    assert len(together)
    n = min(len(alone), len(together))
    assert len(alone) != len(together) or np.abs(alone.bev - together.bev)[:n].max() > 1e-3


def check_all_parameters_learn(method: IntermediateFusion, detector: PointPillars) -> None:
    """The loss is finite and has a gradient in every parameter, frames with one agent included."""
    torch.manual_seed(4)  # a unit that happens to be 0 everywhere has no gradient
    samples = [sample_of([view(detector, 0), view(detector, 1)]), sample_of([view(detector, 2)])]
    targets = []
    for sample in samples:
        assert sample.truth is not None
        rows = np.column_stack([sample.truth.center, sample.truth.size, sample.truth.yaw])
        targets.append(assign_targets(rows, np.zeros(len(rows), dtype=bool), method.anchors))
    for turn in method.turns:  # at first they add 0, so that only their last layer has a gradient
        assert isinstance(turn, Turn)
        torch.nn.init.normal_(turn.last.weight, std=0.1)
    method.train()
    batch, loss = collate_targets(targets, len(method.anchors)), DetectionLoss(method.config)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        assert torch.isfinite(method.loss(samples, batch, loss)["total"])  # no precisions are mixed up
    terms = method.loss(samples, batch, loss)
    terms["total"].backward()  # type: ignore[no-untyped-call]
    assert all(torch.isfinite(term) for term in terms.values())
    idle = [name for name, p in method.named_parameters() if p.grad is None or not p.grad.abs().max() > 0]
    assert not idle
    assert all(p.grad is None for p in detector.parameters())


def check_weights_survive_saving(
    method: IntermediateFusion, another: IntermediateFusion, detector: PointPillars, tmp_path: Path
) -> None:
    """A method that loads what another saved does the same; `another` has other weights before."""
    with torch.no_grad():
        for parameter in another.parameters():
            parameter.add_(0.1)
    ego, other = view(detector, 0), view(detector, 1)
    received = [sent(method, other, POSES[0])]
    wanted = method.fuse(ego, received)
    method.save(tmp_path / "weights.safetensors")
    another.load(tmp_path / "weights.safetensors")
    assert_same_boxes(another.fuse(ego, received), wanted, atol=0.0)
