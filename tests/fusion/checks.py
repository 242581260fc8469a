"""A small detector, what it sees, and what is true of every fusion method."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TypeVar

import numpy as np
import torch

from cobevglue import Boxes
from cobevglue.fusion import FusionSample, IntermediateFusion, Received
from cobevglue.messages import decode_arrays, encode_arrays
from cobevglue.perception import (
    Perception,
    PerceptionOutput,
    PointPillars,
    PointPillarsConfig,
)
from cobevglue.se2 import SE2
from cobevglue.typing import Float32Array

Method = TypeVar("Method", bound=IntermediateFusion)

SMALL = PointPillarsConfig(
    x_range=(-12.8, 12.8), y_range=(-6.4, 6.4), pillar_channels=16, block_layers=(1, 1, 1), block_channels=(8, 8, 12),
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
