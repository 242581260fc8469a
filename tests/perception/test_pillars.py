"""Pillars: every point counts once, in the right place, and nothing else does."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from cobevglue.perception import PointPillarsConfig
from cobevglue.perception.pillars import PillarEncoder, batch_clouds
from cobevglue.typing import ArrayLike

CONFIG = PointPillarsConfig(x_range=(-3.2, 3.2), y_range=(0.0, 3.2), pillar_channels=16, use_intensity=True)
"""8 rows, 16 columns."""


def encoder(training: bool = False) -> PillarEncoder:
    torch.manual_seed(1)
    pillars = PillarEncoder(CONFIG)
    pillars.norm.running_mean = torch.randn(16)
    return pillars.train(training)


def image_of(*clouds: ArrayLike, pillars: PillarEncoder | None = None) -> torch.Tensor:
    points, cloud = batch_clouds([torch.from_numpy(np.asarray(c, dtype=np.float32).reshape(-1, 4)) for c in clouds])
    image: torch.Tensor = (pillars or encoder())(points, cloud, len(clouds))
    return image


def naive(cloud: np.ndarray, pillars: PillarEncoder) -> torch.Tensor:
    """As the paper says it, pillar by pillar and point by point."""
    image = torch.zeros(16, 8, 16)
    groups: dict[tuple[int, int], list[np.ndarray]] = {}
    for point in cloud.astype(np.float64):
        if np.isfinite(point).all() and -3.2 <= point[0] < 3.2 and 0 <= point[1] < 3.2 and -3 <= point[2] < 1:
            groups.setdefault((int(point[1] // 0.4), int((point[0] + 3.2) // 0.4)), []).append(point)
    for (row, column), points in groups.items():
        mean = np.mean(points, axis=0)[:3]
        center = np.array([-3.2 + (column + 0.5) * 0.4, (row + 0.5) * 0.4, -1.0])
        described = [
            [p[0] / 3.2, p[1] / 1.6 - 1, (p[2] + 1) / 2]
            + [*((p[:3] - mean) / (0.2, 0.2, 2)), *((p[:3] - center) / (0.2, 0.2, 2)), p[3]]
            for p in points
        ]
        lifted = pillars.norm(pillars.linear(torch.tensor(described, dtype=torch.float32)))
        image[:, row, column] = lifted.relu().amax(dim=0)
    return image


OFF_THE_EDGES = st.integers(-40, 40).map(lambda i: 0.1 * i + 0.05)
CLOUDS = st.integers(0, 30).flatmap(lambda n: arrays(np.float64, (n, 4), elements=OFF_THE_EDGES))


@settings(max_examples=40, deadline=None)
@given(CLOUDS)
def test_image_equals_loop_over_pillars(cloud: np.ndarray) -> None:
    with torch.no_grad():
        assert torch.allclose(image_of(cloud)[0], naive(cloud, encoder()), atol=1e-4)


def test_rows_are_y_and_columns_are_x() -> None:
    image = image_of([[-3.1, 0.1, 0, 0]], [[3.1, 0.1, 0, 0]], [[-3.1, 3.1, 0, 0]])
    where = [tuple(image[b].abs().sum(dim=0).nonzero()[0].tolist()) for b in range(3)]
    assert where == [(0, 0), (0, 15), (7, 0)]


@pytest.mark.parametrize(
    "point",
    [
        [3.2, 1, 0, 0],
        [-3.3, 1, 0, 0],
        [0, -0.001, 0, 0],
        [0, 3.2, 0, 0],
        [0, 1, 1, 0],
        [0, 1, -3.1, 0],
        [math.nan, 1, 0, 0],
        [0, math.inf, 0, 0],
        [0, 1, -math.inf, 0],
        [1e30, 1, 0, 0],
    ],
)
def test_invalid_points_change_nothing(point: list[float]) -> None:
    good = [[0.5, 1, 0, 0.5], [0.6, 1.1, -1, 0.2]]
    assert torch.equal(image_of([*good, point]), image_of(good))
    assert not image_of([point]).any(), "alone they are an empty cloud"


@pytest.mark.parametrize("intensity", [math.nan, math.inf, -math.inf])
def test_an_intensity_not_finite_counts_as_zero(intensity: float) -> None:
    assert torch.equal(image_of([[0.5, 1, 0, intensity]]), image_of([[0.5, 1, 0, 0]]))
    assert image_of([[0.5, 1, 0, intensity]]).any(), "the point is there"


def test_batched_clouds_are_independent_and_may_be_empty() -> None:
    a, b = np.random.default_rng(0).uniform(-1, 3, (2, 50, 4))
    image = image_of(a, np.zeros((0, 4)), b)
    assert torch.allclose(image[0], image_of(a)[0], atol=1e-6)
    assert torch.allclose(image[2], image_of(b)[0], atol=1e-6)
    assert not image[1].any()


@pytest.mark.parametrize("clouds", [[np.zeros((0, 4))], [np.zeros((0, 4)), np.zeros((0, 4))]])
def test_training_on_empty_clouds_works(clouds: list[np.ndarray]) -> None:
    assert image_of(*clouds, pillars=encoder(training=True)).sum() == 0


def test_gradients_are_those_of_a_loop() -> None:
    cloud = np.random.default_rng(1).uniform(-1, 3, (40, 4))
    gradients = []
    weight = torch.randn(16, 8, 16)
    for image in (lambda p: image_of(cloud, pillars=p)[0], lambda p: naive(cloud, p)):
        pillars = encoder()
        (image(pillars) * weight).sum().backward()  # type: ignore[no-untyped-call]
        assert pillars.linear.weight.grad is not None
        gradients.append(pillars.linear.weight.grad)
    assert torch.allclose(gradients[0], gradients[1], atol=1e-4)
