"""A detector small enough to be trained within a test, and a cloud to train it on."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
import torch

from cobevglue.perception import DetectionLoss, PointPillars, PointPillarsConfig, assign_targets, collate_targets
from cobevglue.typing import Float32Array, FloatArray

SMALL = PointPillarsConfig(
    x_range=(-12.8, 12.8),
    y_range=(-9.6, 9.6),
    pillar_channels=16,
    block_layers=(1, 1, 1),
    block_channels=(12, 16, 24),
    up_channels=12,
    shrink_channels=16,
)
OBJECTS = np.array(
    [
        [5.0, 3.0, -1.0, 4.5, 1.9, 1.6, 0.5],
        [-6.0, -4.0, -1.0, 4.2, 1.8, 1.5, -2.3],
        [-5.0, 4.5, -0.3, 10.0, 2.6, 3.2, 3.0],
        [6.0, -5.0, -1.0, 2.2, 0.8, 1.4, 1.2],
    ]
)
"""Two cars, a bus and a motorcycle: x, y, z, l, w, h [m], yaw [rad]."""


def cloud_of(objects: FloatArray, seed: int = 0) -> Float32Array:
    """(N, 4) points on a ground and in objects, which are lower in front so that the heading can be seen."""
    rng = np.random.default_rng(seed)
    parts = [np.column_stack([rng.uniform(-12.8, 12.8, 1500), rng.uniform(-9.6, 9.6, 1500), np.full(1500, -1.9)])]
    for x, y, z, length, width, height, yaw in objects:
        p = rng.uniform(-0.5, 0.5, (200, 3)) * (length, width, height)
        p[:, 2] -= 0.4 * height * (p[:, 0] > 0.15 * length)
        c, s = np.cos(yaw), np.sin(yaw)
        parts.append(np.column_stack([p[:, 0] * c - p[:, 1] * s + x, p[:, 0] * s + p[:, 1] * c + y, p[:, 2] + z]))
    xyz = np.concatenate(parts)
    return np.column_stack([xyz, rng.random(len(xyz))]).astype(np.float32)


@pytest.fixture(autouse=True, scope="session")
def _one_thread() -> Iterator[None]:
    """Small maps are faster so, and beside other tests much faster."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


@pytest.fixture
def detector() -> PointPillars:
    """Small, with random weights, in evaluation mode; low threshold, so that it finds something."""
    torch.manual_seed(0)
    detector = PointPillars(SMALL).eval()
    detector.detection = detector.detection.model_copy(update={"score_threshold": 0.0, "max_detections": 20})
    return detector


@pytest.fixture(scope="session")
def trained() -> PointPillars:
    """Small, and knows one cloud by heart."""
    torch.manual_seed(0)
    detector = PointPillars(SMALL)
    for module in detector.modules():
        if isinstance(module, torch.nn.BatchNorm1d | torch.nn.BatchNorm2d):
            module.momentum = 0.3  # so few steps are too few for 0.01
    cloud = torch.from_numpy(cloud_of(OBJECTS))
    targets = assign_targets(OBJECTS, np.zeros(len(OBJECTS), dtype=bool), detector.anchors)
    batch = collate_targets([targets], len(detector.anchors))
    loss = DetectionLoss(SMALL)
    optimizer = torch.optim.AdamW(detector.parameters(), lr=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 1e-2, total_steps=160)
    for _ in range(160):
        optimizer.zero_grad()
        loss(detector([cloud]), batch).total.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()
    return detector.eval()
