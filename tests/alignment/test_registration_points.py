"""Points under a budget: what travels, and how many bytes it is."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cobevglue import SE2
from cobevglue.alignment import ALIGNERS, Observation, group_aligner
from cobevglue.alignment.registration.points import (
    PointAligner,
    Sketch,
    height_above_ground,
    one_per_voxel,
    within_reach,
)
from cobevglue.typing import Float32Array

from .observations import cloud_of, pose_of, scene

NAMES = ("icp-2d", "icp-3d", "fpfh-teaser")
CLOUD = cloud_of(scene(0), SE2(), 0)


def aligner(name: str, budget: int | None = None) -> PointAligner:
    made = group_aligner(name, budget_bytes=budget)
    assert isinstance(made, PointAligner)
    return made


def seen_by(name: str, cloud: Float32Array = CLOUD) -> Observation:
    """All that an agent knows, as far as this aligner may look at it."""
    return aligner(name).select_inputs(Observation(points=cloud, pose=pose_of(SE2(3.0, 4.0, 0.5))))


def sent(name: str, budget: int | None, observation: Observation, frame: int = 0) -> dict[str, bytes]:
    return aligner(name, budget).encode("car1", observation, 0.0, frame)


@given(name=st.sampled_from(NAMES), budget=st.integers(256, 60_000))
@settings(max_examples=40, deadline=None)
def test_messages_fill_but_never_exceed_the_budget(name: str, budget: int) -> None:
    observation = seen_by(name)
    parts = sent(name, budget, observation)
    size = sum(len(part) for part in parts.values())
    assert size <= budget
    everything = sum(len(part) for part in sent(name, None, observation).values())
    assert size > min(budget, everything) - 6


@pytest.mark.parametrize("name", NAMES)
def test_a_message_of_nothing_fits_the_smallest_budget(name: str) -> None:
    assert sum(len(part) for part in sent(name, 256, seen_by(name, CLOUD[:0])).values()) <= 256


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("budget", [None, 5000])
def test_points_arrive_within_a_centimetre(name: str, budget: int | None) -> None:
    """Each is one that the method looks at, rounded; and what was not told does not arrive."""
    observation = seen_by(name)
    one = aligner(name, budget)
    arrived = one.decode(one.encode("car1", observation, 0.0, 0), observation)
    standing = one.standing(within_reach(CLOUD))
    assert isinstance(arrived, Sketch)
    assert arrived.points is not None
    assert arrived.points.shape[1] == standing.shape[1] == (2 if name == "icp-2d" else 3)
    assert arrived.points.dtype == np.float32
    rounded = {tuple(row) for row in np.round(standing * 100.0).astype(int).tolist()}
    assert {tuple(row) for row in np.round(arrived.points * 100.0).astype(int).tolist()} <= rounded
    assert np.abs(arrived.points * 100.0 - np.round(arrived.points * 100.0)).max() < 0.01
    if budget is None:
        np.testing.assert_allclose(arrived.points, standing[one_per_voxel(standing, one.voxel)], atol=0.00501)
    assert (arrived.boxes, arrived.variance, arrived.features) == (None, None, None)
    if name == "fpfh-teaser":
        assert arrived.pose is None
    else:
        np.testing.assert_array_equal(arrived.pose, observation.pose)


@pytest.mark.parametrize("name", NAMES)
def test_received_points_are_not_sampled_again(name: str) -> None:
    one = aligner(name)
    observation = seen_by(name)
    arrived = one.decode(one.encode("car1", observation, 0.0, 0), observation)
    assert one.sketch(arrived) is arrived
    mine = one.sketch(observation)
    assert mine.points is not None
    assert arrived.points is not None
    assert mine.voxel == arrived.voxel == one.voxel
    np.testing.assert_allclose(arrived.points, mine.points, atol=0.00501)


def test_sampling_is_deterministic_per_frame() -> None:
    observation = seen_by("icp-3d")
    first, again, next_one = (sent("icp-3d", 3000, observation, frame) for frame in (4, 4, 5))
    assert first == again
    assert first["points"] != next_one["points"]
    assert first["pose"] == next_one["pose"]


def test_the_sample_is_spread_evenly() -> None:
    """No two points share a cell of the grid that the message names; and one step coarser, they would be too few."""
    observation = seen_by("icp-3d")
    for budget in (20_000, 5_000, 1_000):
        one = aligner("icp-3d", budget)
        arrived = one.decode(one.encode("car1", observation, 0.0, 0), observation)
        assert isinstance(arrived, Sketch)
        assert arrived.points is not None
        standing = one.standing(within_reach(CLOUD))
        kept = standing[one_per_voxel(standing, arrived.voxel)]
        sent_rows = {tuple(row) for row in np.round(arrived.points * 100.0).astype(int).tolist()}
        assert sent_rows <= {tuple(row) for row in np.round(kept * 100.0).astype(int).tolist()}
        assert len(one_per_voxel(standing, 1.05 * arrived.voxel)) < len(arrived.points) <= len(kept)


@pytest.mark.parametrize("name", NAMES)
def test_only_needed_fields_are_transmitted(name: str) -> None:
    everything = Observation(points=CLOUD, pose=np.eye(4), variance=np.ones((0, 3)))
    needed = aligner(name).select_inputs(everything)
    assert (needed.variance, needed.boxes, needed.features) == (None, None, None)
    assert (needed.pose is None) == (name == "fpfh-teaser")
    assert set(sent(name, None, needed)) == {"points"} | ({"pose"} if "icp" in name else set())


@pytest.mark.parametrize("name", ["icp-2d", "icp-3d"])
def test_a_refinement_asks_for_a_pose(name: str) -> None:
    with pytest.raises(ValueError, match="needs pose of every agent"):
        aligner(name).select_inputs(Observation(points=CLOUD))


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("budget", [0, -1, 255])
def test_a_budget_holds_at_least_a_pose(name: str, budget: int) -> None:
    with pytest.raises(ValueError, match="budget_bytes must be at least 256"):
        ALIGNERS[name](budget_bytes=budget)  # type: ignore[call-arg]


def test_points_that_cannot_be_sent_are_left_out() -> None:
    cloud = np.zeros((4, 4))
    cloud[1, 0], cloud[2, 1], cloud[3, 2] = 1e6, math.nan, -math.inf
    assert within_reach(cloud).tolist() == [[0.0, 0.0, 0.0]]


def test_one_point_of_each_voxel_stays() -> None:
    points = np.array([[0.1, 0.1], [0.9, 0.9], [1.1, 0.5], [-0.1, 0.5], [0.5, 0.5]])
    assert one_per_voxel(points, 1.0).tolist() == [0, 2, 3]
    assert one_per_voxel(points[:0], 1.0).tolist() == []


@pytest.mark.parametrize(("height", "roll", "pitch"), [(1.9, 0.0, 0.0), (1.9, 1.0, -1.5), (5.0, 0.5, 0.0)])
def test_the_ground_is_where_the_sensor_leans_to(height: float, roll: float, pitch: float) -> None:
    """A street corner under a sensor that is mounted askew, on a car and on a mast."""
    world = scene(1)
    world[:, 2] += 1.9
    slope = np.array([math.tan(math.radians(roll)), math.tan(math.radians(pitch))])
    seen = world - np.column_stack([np.zeros((len(world), 2)), height + world[:, :2] @ slope])
    np.testing.assert_allclose(height_above_ground(seen), world[:, 2], atol=0.1)


def test_few_points_have_heights_above_the_lowest() -> None:
    assert height_above_ground(np.array([[1.0, 0.0, -1.0], [2.0, 0.0, 0.5]])).tolist() == [0.0, 1.5]
    assert height_above_ground(np.zeros((0, 3))).shape == (0,)
