"""Heading refinement tells front from back, for either direction of the box."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import assume, given
from hypothesis import strategies as st

from cobevglue.boxes import Boxes
from cobevglue.perception import Perception, PointPillars
from cobevglue.perception.decode import Detections
from cobevglue.perception.heading import HeadingInputs, HeadingRefiner, heading_inputs, refine_headings
from cobevglue.se2 import SE2, wrap_angle
from cobevglue.typing import Float32Array

from .conftest import OBJECTS, cloud_of


def found(*vehicles: tuple[float, ...], heading_confidence: float = 0.5) -> Detections:
    """Vehicles x, y, z, l, w, h, yaw."""
    rows = np.array(vehicles, dtype=np.float64).reshape(-1, 7)
    boxes = Boxes(rows[:, :3], rows[:, 3:6], rows[:, 6], np.full(len(rows), 0.8), label=np.full(len(rows), "vehicle"))
    return Detections(boxes, np.full((len(rows), 3), 0.1), np.full(len(rows), heading_confidence))


def random_net(seed: int = 0) -> HeadingRefiner:
    """With an opinion, but no idea."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = HeadingRefiner()
        torch.nn.init.normal_(net.vehicle[-1].weight)  # type: ignore[arg-type]
    return net.eval()


CAR = (10.0, 5.0, -1.0, 4.0, 2.0, 1.6, math.pi / 2)
"""Faces along y."""


@pytest.mark.parametrize(
    ("point", "seen"),
    [
        ((10.0, 7.0, -1.0), (2.0, 0.0, 0.0)),  # on the bumper ahead
        ((9.0, 5.0, -0.5), (0.0, 1.0, 0.5)),  # on the left door: left is towards -x
        ((10.0, 7.25, -1.0), (2.25, 0.0, 0.0)),  # what the box missed by less than 0.3 m
        ((10.0, 7.35, -1.0), None),  # by more
        ((11.25, 5.0, -1.0), (0.0, -1.25, 0.0)),  # the same to the right
        ((10.0, 5.0, 0.15), (0.0, 0.0, 1.15)),  # on a roof that is higher than was thought
        ((10.0, 5.0, 0.25), None),  # a branch above it
        ((10.0, 5.0, -1.85), (0.0, 0.0, -0.85)),  # hardly below it
        ((10.0, 5.0, -1.95), None),  # the ground
        ((math.nan, 5.0, -1.0), None),  # no point
    ],
)
def test_points_are_seen_in_the_vehicles_axes(
    point: tuple[float, float, float], seen: tuple[float, float, float] | None
) -> None:
    cloud = np.array([[-3.0, 0.0, 0.0, 0.1], [*point, 0.5]], dtype=np.float32)
    looks = heading_inputs(cloud, found(CAR))
    assert looks.number.tolist() == [int(seen is not None)]
    np.testing.assert_allclose(looks.points[0, 0].numpy(), (0, 0, 0) if seen is None else seen, atol=1e-5)
    assert not looks.points[0, 1:].any()
    np.testing.assert_allclose(looks.vehicle.numpy(), [[*CAR, 0.8, 0.5]], rtol=1e-6)


def test_points_are_subsampled_evenly_and_counted() -> None:
    along = np.linspace(3.1, 6.9, 1000)
    cloud = np.column_stack([np.full(1000, 10.0), along, np.full((1000, 2), -1.0)]).astype(np.float32)
    looks = heading_inputs(cloud, found(CAR))
    assert looks.number.tolist() == [1000]
    assert np.ptp(looks.points[0, :, 0].numpy()) > 3.6
    assert len(np.unique(looks.points[0, :, 0].numpy())) == looks.points.shape[1]


def test_neighbours_are_in_vehicle_axes() -> None:
    """To a car that faces along y: one 8 m ahead that faces as it does, one to its left that comes towards it."""
    ahead, left = (10.0, 13.0, -1.0, 4.0, 2.0, 1.6, math.pi / 2), (7.0, 5.0, -1.0, 4.0, 2.0, 1.6, -math.pi / 2)
    vehicles = found(CAR, ahead, left)
    around = heading_inputs(
        np.zeros((0, 4), np.float32), vehicles._replace(heading_confidence=np.array([0.1, 0.2, 0.3]))
    ).around
    np.testing.assert_allclose(around[0, 0].numpy(), [0, 3, -1, 0, 0.8, 0.3], atol=1e-6)
    np.testing.assert_allclose(around[0, 1].numpy(), [8, 0, 1, 0, 0.8, 0.2], atol=1e-6)
    assert not around[0, 2:].any()


def test_of_many_others_the_nearest_are_seen() -> None:
    row = [(float(x), 0.0, -1.0, 4.0, 2.0, 1.6, 0.0) for x in range(0, 100, 5)]
    around = heading_inputs(np.zeros((0, 4), np.float32), found(*row)).around
    assert around[0, :, 0].tolist() == [5.0 * i for i in range(1, around.shape[1] + 1)]
    assert not heading_inputs(np.zeros((0, 4), np.float32), found(CAR)).around.any()


def clouds_and_vehicles() -> st.SearchStrategy[tuple[Float32Array, Detections]]:
    """A cloud of a few points about some vehicles, which may have none."""
    number = st.floats(-30.0, 30.0, width=32)
    vehicle = st.tuples(
        number, number, st.floats(-2.0, 1.0), st.floats(2.0, 12.0), st.floats(0.8, 3.0), st.floats(1.0, 4.0),
        st.floats(-math.pi, math.pi),
    )  # fmt: skip
    return st.tuples(
        st.lists(vehicle, min_size=1, max_size=4), st.integers(0, 2**31), st.integers(0, 300), st.floats(0.0, 1.0)
    ).map(lambda t: (_around(t[0], t[1], t[2]), found(*t[0], heading_confidence=t[3])))


def _around(vehicles: list[tuple[float, ...]], seed: int, count: int) -> Float32Array:
    rng = np.random.default_rng(seed)
    center = np.array(vehicles)[rng.integers(len(vehicles), size=count), :3]
    return np.column_stack([center + rng.normal(size=(count, 3)), rng.random(count)]).astype(np.float32)


@given(clouds_and_vehicles(), st.integers(0, 5))
def test_reversed_box_gets_negated_logit(case: tuple[Float32Array, Detections], seed: int) -> None:
    """So the vehicle faces the same way after all, whatever the box said and whatever was learnt."""
    cloud, vehicles = case
    net = random_net(seed)
    with torch.inference_mode():
        one = net(heading_inputs(cloud, vehicles)).numpy()
    assert np.isfinite(one).all()
    for row in range(len(one)):
        yaw = vehicles.boxes.yaw.copy()
        yaw[row] = wrap_angle(yaw[row] + math.pi)
        looks = heading_inputs(cloud, vehicles._replace(boxes=vehicles.boxes.replace(yaw=yaw)))
        looks.vehicle[row, 8] *= -1.0  # the head was as sure that it faces the other way
        with torch.inference_mode():
            np.testing.assert_allclose(net(looks)[row].item(), -one[row], atol=1e-3)


@given(clouds_and_vehicles(), st.floats(-math.pi, math.pi))
def test_sensor_orientation_does_not_matter(case: tuple[Float32Array, Detections], angle: float) -> None:
    """A mast has no lane of its own."""
    cloud, vehicles = case
    pose = SE2(0.0, 0.0, angle)
    turned = np.column_stack([pose.apply(cloud[:, :3]), cloud[:, 3]]).astype(np.float32)
    looks = heading_inputs(cloud, vehicles)
    again = heading_inputs(turned, vehicles._replace(boxes=vehicles.boxes.transform(pose)))
    assume(torch.equal(looks.number, again.number))  # no point is on an edge
    assume(int(looks.number.max()) <= looks.points.shape[1])  # of more, others may be taken
    assume(len(cloud) == 0 or _far_from_ties(vehicles))
    net = random_net()
    with torch.inference_mode():
        np.testing.assert_allclose(net(again).numpy(), net(looks).numpy(), atol=2e-2, rtol=1e-3)


def _far_from_ties(vehicles: Detections) -> bool:
    """No two others are equally far from a vehicle, so that which come first is no matter of rounding."""
    gap = np.hypot(*(vehicles.boxes.center[:, None, :2] - vehicles.boxes.center[None, :, :2]).T)
    return all(np.diff(np.sort(row)).min(initial=1.0) > 1e-3 for row in gap)


@given(clouds_and_vehicles())
def test_boxes_with_negative_logit_are_reversed_only(case: tuple[Float32Array, Detections]) -> None:
    cloud, vehicles = case
    net = random_net()
    with torch.inference_mode():
        wrong = net(heading_inputs(cloud, vehicles)).numpy() < 0
    after = refine_headings(vehicles, cloud, net)
    np.testing.assert_allclose(np.abs(wrap_angle(after.boxes.yaw - vehicles.boxes.yaw)), math.pi * wrong, atol=1e-9)
    np.testing.assert_array_equal(after.boxes.center, vehicles.boxes.center)
    np.testing.assert_array_equal(after.boxes.size, vehicles.boxes.size)
    np.testing.assert_array_equal(after.variance, vehicles.variance)
    assert ((after.heading_confidence >= 0) & (after.heading_confidence <= 1)).all()
    again = refine_headings(after, cloud, net)
    assert len(again.boxes) == len(vehicles.boxes)


def test_untrained_it_leaves_everything_as_it_is() -> None:
    vehicles = found(CAR, (0.0, -8.0, -1.0, 4.5, 1.8, 1.5, 2.0))
    after = refine_headings(vehicles, cloud_of(OBJECTS), HeadingRefiner().eval())
    np.testing.assert_array_equal(after.boxes.yaw, vehicles.boxes.yaw)
    assert after.heading_confidence.tolist() == [0.0, 0.0]


def test_nothing_found_is_nothing_to_look_at() -> None:
    nothing = found()
    assert refine_headings(nothing, cloud_of(OBJECTS), random_net()) is nothing


def test_padding_rows_are_ignored() -> None:
    looks = heading_inputs(_around([CAR], 0, 20), found(CAR))
    rubbish = looks.points.clone()
    rubbish[0, int(looks.number[0]) :] = 99.0
    net = random_net()
    with torch.inference_mode():
        assert torch.equal(net(looks), net(looks._replace(points=rubbish)))


def test_it_learns_that_bonnets_are_low() -> None:
    """From vehicles at all headings, half of whose boxes are the wrong way round; then on others."""

    def vehicles(seed: int, count: int) -> tuple[HeadingInputs, torch.Tensor]:
        rng = np.random.default_rng(seed)
        xy = rng.uniform(-40, 40, (count, 2))
        size = rng.uniform([3.6, 1.7, 1.4], [5.0, 2.0, 1.9], (count, 3))
        yaw = rng.uniform(-math.pi, math.pi, count)
        right = rng.random(count) < 0.5
        number = rng.integers(8, 64, count)
        p = rng.uniform(-0.5, 0.5, (count, 64, 3)) * size[:, None]
        p[..., 2] -= 0.4 * size[:, None, 2] * (p[..., 0] > 0.15 * size[:, None, 0])
        p[..., :2] *= np.where(right, 1.0, -1.0)[:, None, None]
        said = np.where(right, yaw, yaw + math.pi)
        vehicle = np.column_stack([xy, np.full(count, -1.0), size, said, np.full(count, 0.8), np.full(count, 0.3)])
        alone = torch.zeros(count, 8, 6)
        looks = HeadingInputs(
            torch.from_numpy(p).float(), torch.from_numpy(number), torch.from_numpy(vehicle).float(), alone
        )
        return looks, torch.from_numpy(right)

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        net = HeadingRefiner()
    looks, right = vehicles(1, 512)
    optimizer = torch.optim.AdamW(net.parameters(), lr=3e-3)
    for _ in range(60):
        loss = torch.nn.functional.binary_cross_entropy_with_logits(net(looks), right.float())
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    looks, right = vehicles(2, 512)
    with torch.inference_mode():
        assert ((net(looks) > 0) == right).float().mean() > 0.95


def test_heading_refinement_can_be_switched_off(trained: PointPillars) -> None:
    """Alone and in `Perception`; the settings switch it off."""
    cloud = cloud_of(OBJECTS)
    first = trained.detection
    trained.heading_refiner, net = random_net(3), trained.heading_refiner
    try:
        with torch.inference_mode():
            (seen,) = trained.boxes(trained([torch.from_numpy(cloud)]))
        wrong = trained.heading_refiner(heading_inputs(cloud, seen)).detach().numpy() < 0
        assert 0 < wrong.sum() < len(wrong)  # or this test would show little
        expected = wrap_angle(seen.boxes.yaw + math.pi * wrong)
        np.testing.assert_allclose(trained.detect(cloud).yaw, expected, atol=1e-6)
        np.testing.assert_allclose(Perception(trained).step(cloud).detections.yaw, expected, atol=1e-6)
        trained.detection = first.model_copy(update={"heading_refinement": False})
        np.testing.assert_allclose(trained.detect(cloud).yaw, seen.boxes.yaw, atol=1e-6)
    finally:
        trained.detection, trained.heading_refiner = first, net
