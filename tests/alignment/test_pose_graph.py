"""CoAlign's pose graph: what it repairs, what it leaves alone, and how detections are weighed."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import least_squares

from cobevglue import SE2, Boxes
from cobevglue.alignment import Observation, group_aligner
from cobevglue.alignment.pose_graph import CoAlign, Detections, find_landmarks, optimise
from cobevglue.typing import FloatArray, IntArray

from .observations import align, boxes_at, error, pose_of
from .scenes import cars, mahalanobis, pair_of_views, pairs_of, random_boxes, random_pose

EXACT = (0.0, 0.0, 0.0, 0.0)
FOUR = cars([(12, 4, 10), (25, -6, 170), (40, 9, -80), (31, 20, 45)])
"""Four cars, in the world."""
OFF = SE2(0.5, -0.4, math.radians(1.0))
"""A localisation error."""
CAR1, CAR2, CAR3 = SE2(3.0, 1.0, 0.2), SE2(50.0, 5.0, 3.0), SE2(30.0, -30.0, 1.5)


def seen_from(world_SE2_lidar: SE2, world: Boxes = FOUR) -> Boxes:
    return world.transform(world_SE2_lidar.inverse())


def detections_of(rows: FloatArray, agents: IntArray) -> Detections:
    """Boxes at x, y, yaw in a frame where all agents stand at the origin."""
    return Detections(agents, np.arange(len(agents)), np.asarray(rows, np.float64), np.ones((len(agents), 3)))


def landmarks(xy: FloatArray, agents: IntArray, gate: float = 1.5) -> list[set[int]]:
    """Groups of rows."""
    detections = detections_of(np.column_stack([xy, np.zeros(len(xy))]), agents)
    labels = find_landmarks(detections, np.zeros((int(agents.max()) + 1, 3)), gate)
    return [set(np.flatnonzero(labels == k).tolist()) for k in range(labels.max(initial=-1) + 1)]


# What it repairs


def test_four_exact_landmarks_give_the_exact_pose() -> None:
    found = align(CoAlign(), {"car1": boxes_at(seen_from(CAR1), CAR1), "car2": boxes_at(seen_from(CAR2), CAR2 @ OFF)})[
        "car2"
    ]
    assert error(found, CAR1.inverse() @ CAR2) == pytest.approx((0.0, 0.0), abs=1e-4)  # variances travel as float32
    assert pairs_of(found) == {(i, i) for i in range(4)}


@given(seed=st.integers(0, 10**6), n=st.integers(4, 12))
@settings(max_examples=30, deadline=None)
def test_exact_boxes_give_the_pose_to_machine_precision(seed: int, n: int) -> None:
    """Whatever the variances and wherever the world's origin."""
    pair = pair_of_views(n, seed, only_ego=3, only_other=3, noise=EXACT)
    rng = np.random.default_rng([seed, 3, 0])
    world_SE2_ego = random_pose(rng, 300.0)
    x, y, yaw = rng.uniform((-0.3, -0.3, -0.005), (0.3, 0.3, 0.005))
    off = SE2(x, y, yaw)
    observations = {
        "ego": boxes_at(pair.ego, world_SE2_ego, rng.uniform(0.001, 0.15, (len(pair.ego), 3))),
        "other": boxes_at(
            pair.other, world_SE2_ego @ pair.ego_SE2_other @ off, rng.uniform(0.001, 0.15, (len(pair.other), 3))
        ),
    }
    found = CoAlign().align_group("ego", observations)["other"]
    assert error(found, pair.ego_SE2_other) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert pairs_of(found) == {(int(m), int(k)) for m, k in pair.matches}


def test_agents_are_solved_for_jointly() -> None:
    """car3 shares no car with the ego, only with car2: through it, it is placed all the same."""
    world = random_boxes(12, np.random.default_rng([5, 0, 0]), reach=30.0)
    found = align(
        CoAlign(),
        {
            "car1": boxes_at(seen_from(CAR1, world[:6]), CAR1),
            "car2": boxes_at(seen_from(CAR2, world), CAR2 @ OFF),
            "car3": boxes_at(seen_from(CAR3, world[6:]), CAR3 @ OFF.inverse()),
        },
    )
    assert error(found["car2"], CAR1.inverse() @ CAR2) == pytest.approx((0.0, 0.0), abs=1e-4)
    assert error(found["car3"], CAR1.inverse() @ CAR3) == pytest.approx((0.0, 0.0), abs=1e-4)
    assert len(found["car2"].matches) == 6
    assert found["car3"].matches.shape == (0, 2)


def test_reversed_headings_do_not_matter() -> None:
    turned = seen_from(CAR2)
    turned = turned.replace(yaw=turned.yaw + np.array([math.pi, 0.0, -math.pi, 0.0]))
    found = align(CoAlign(), {"car1": boxes_at(seen_from(CAR1), CAR1), "car2": boxes_at(turned, CAR2 @ OFF)})["car2"]
    assert error(found, CAR1.inverse() @ CAR2) == pytest.approx((0.0, 0.0), abs=1e-4)


def test_an_uncertain_box_moves_the_pose_less() -> None:
    """car2 sees the third car half a metre off, and either knows or does not know that it is unsure of it."""
    moved = seen_from(CAR2)
    moved = moved.replace(center=moved.center + np.eye(4)[:, 2:3] * (0.5, 0.3, 0.0))
    errors = []
    for unsure in (0.01, 1.0, 100.0):
        variance = np.full((4, 3), 0.01)
        variance[2, :2] = unsure
        found = align(CoAlign(), {"car1": boxes_at(seen_from(CAR1), CAR1), "car2": boxes_at(moved, CAR2, variance)})
        errors.append(error(found["car2"], CAR1.inverse() @ CAR2)[0])
    assert errors[0] > 0.1
    assert errors[1] < 0.2 * errors[0]
    assert errors[2] < 0.02 * errors[0]


def test_it_is_weighted_least_squares() -> None:
    """Against scipy's solver on the same cost, written down with complex numbers."""
    rng = np.random.default_rng([7, 0, 0])
    world = random_boxes(6, rng)
    poses = np.array([[0.0, 0.0, 0.0], [20.0, 5.0, 1.0], [-10.0, 30.0, -2.0]])
    agents, landmark = np.repeat(np.arange(3), 6), np.tile(np.arange(6), 3)
    measured = np.concatenate(
        [np.column_stack([seen.center[:, :2], seen.yaw]) for seen in (seen_from(SE2(*pose), world) for pose in poses)]
    )
    measured += rng.normal(0.0, 0.1, measured.shape) * (1.0, 1.0, 0.3)
    detections = Detections(agents, landmark, measured, rng.uniform(0.01, 0.5, measured.shape))

    def residuals(state: FloatArray) -> FloatArray:
        others, objects = state[:6].reshape(2, 3), state[6:].reshape(6, 3)
        stands = np.concatenate([poses[:1], others])[agents]
        seen = objects[landmark]
        gap = ((seen - stands)[:, :2] @ [1.0, 1j]) * np.exp(-1j * stands[:, 2]) - measured[:, :2] @ [1.0, 1j]
        turn = np.angle(np.exp(2j * (seen[:, 2] - stands[:, 2] - measured[:, 2]))) / 2.0
        whitened = np.column_stack([gap.real, gap.imag, turn]) / np.sqrt(detections.variance)
        return np.asarray(whitened.ravel())

    start = np.concatenate([poses[1:].ravel(), np.column_stack([world.center[:, :2], world.yaw]).ravel()])
    expected = least_squares(residuals, start, xtol=1e-14, ftol=1e-14, gtol=1e-14)
    found, covariance = optimise(detections, landmark, poses + rng.normal(0.0, 0.1, (3, 3)) * [[0.0], [1.0], [1.0]])
    np.testing.assert_allclose(found[1:].ravel(), expected.x[:6], atol=1e-6)
    np.testing.assert_allclose(covariance, np.linalg.inv(expected.jac.T @ expected.jac)[:6, :6], rtol=1e-3, atol=1e-7)
    assert found[0].tolist() == [0.0, 0.0, 0.0]


def test_the_covariance_is_honest() -> None:
    """Boxes as uncertain as they say: the error is a chi-square with three degrees."""
    squared = []
    for seed in range(80):
        pair = pair_of_views(8, seed, noise=(0.1, math.radians(1.0), 0.0, 0.0))
        variance = np.array([0.01, 0.01, math.radians(1.0) ** 2])
        ego, other = boxes_at(pair.ego, SE2(), variance), boxes_at(pair.other, pair.ego_SE2_other, variance)
        found = CoAlign().align_group("ego", {"ego": ego, "other": other})["other"]
        assert len(found.matches) == 8
        squared.append(mahalanobis(found, pair.ego_SE2_other))
    assert 2.2 < np.mean(squared) < 3.8


# What it leaves alone


@pytest.mark.parametrize(
    ("common", "variance", "reason"),
    [
        (3, 0.01, "three landmarks are too few"),
        (4, 0.3, "nobody knows any heading"),
        (4, np.array([[0.01] * 3] * 2 + [[0.01, 0.01, 0.5]] * 2), "two of the four headings are not known"),
        (0, 0.01, "car2 sees nothing"),
    ],
)
def test_claims_are_kept_without_enough_landmarks(common: int, variance: float | FloatArray, reason: str) -> None:
    found = align(
        CoAlign(),
        {
            "car1": boxes_at(seen_from(CAR1), CAR1, variance),
            "car2": boxes_at(seen_from(CAR2)[:common], CAR2 @ OFF, variance),
        },
    )["car2"]
    assert error(found, CAR1.inverse() @ CAR2 @ OFF) == pytest.approx((0.0, 0.0), abs=1e-6), reason
    assert found.matches.shape == (0, 2)
    assert np.isinf(found.covariance.diagonal()).all()


def test_landmarks_whose_headings_disagree_are_not_used() -> None:
    """Five cars, one of them seen across by car2 and half a metre off."""
    world = Boxes.concatenate([FOUR, cars([(18, 15, 0)])])
    other = seen_from(CAR2, world)
    other = other.replace(yaw=other.yaw + np.eye(5)[4] * 1.3, center=other.center + np.eye(5)[:, 4:] * (0.5, 0.0, 0.0))
    found = align(CoAlign(), {"car1": boxes_at(seen_from(CAR1, world), CAR1), "car2": boxes_at(other, CAR2)})["car2"]
    assert error(found, CAR1.inverse() @ CAR2) == pytest.approx((0.0, 0.0), abs=1e-4)
    assert pairs_of(found) == {(i, i) for i in range(4)}


def test_disconnected_agent_keeps_its_claimed_pose() -> None:
    """car3 and car4 share four cars with each other, but none with the ego and car2."""
    far = SE2(200.0, 0.0, 0.0)
    observations = {
        "car1": boxes_at(seen_from(CAR1), CAR1),
        "car2": boxes_at(seen_from(CAR2), CAR2 @ OFF),
        "car3": boxes_at(seen_from(CAR1), far @ CAR1),
        "car4": boxes_at(seen_from(CAR2), far @ CAR2 @ OFF),
    }
    found = align(CoAlign(), observations)
    assert error(found["car2"], CAR1.inverse() @ CAR2) == pytest.approx((0.0, 0.0), abs=1e-4)
    assert error(found["car3"], CAR1.inverse() @ far @ CAR1) == pytest.approx((0.0, 0.0), abs=1e-6)
    assert error(found["car4"], CAR1.inverse() @ far @ CAR2 @ OFF) == pytest.approx((0.0, 0.0), abs=1e-6)


def test_an_error_above_the_gate_is_not_repaired() -> None:
    """Every collaborator claims the ego's place."""
    pair = pair_of_views(8, 1)
    found = CoAlign().align_group("ego", {"ego": boxes_at(pair.ego, SE2()), "other": boxes_at(pair.other, SE2())})
    assert error(found["other"], pair.ego_SE2_other)[0] > 5.0


def test_ego_alone_gives_no_poses() -> None:
    assert align(CoAlign(), {"car1": boxes_at(seen_from(CAR1), CAR1)}) == {}


# Landmarks


def test_a_landmark_is_a_transitive_closure() -> None:
    """Three agents' boxes in a row, 1.2 m apart: the first and the last are 2.4 m apart, and one landmark."""
    row = np.array([[0.0, 0.0], [1.2, 0.0], [2.4, 0.0], [9.0, 0.0]])
    assert landmarks(row, np.array([0, 1, 2, 1])) == [{0, 1, 2}]


def test_the_nearest_pair_goes_together() -> None:
    """Agent 1 has two boxes near the one of agent 0."""
    row = np.array([[0.0, 0.0], [1.0, 0.0], [-0.8, 0.0]])
    assert landmarks(row, np.array([0, 1, 1])) == [{0, 2}]


def test_of_equally_near_pairs_the_first_goes_together() -> None:
    row = np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0]])
    assert landmarks(row, np.array([0, 1, 1])) == [{0, 1}]


def test_boxes_of_one_agent_are_never_joined() -> None:
    assert landmarks(np.zeros((3, 2)), np.array([1, 1, 1])) == []


@given(seed=st.integers(0, 10**6), n=st.integers(1, 30), agents=st.integers(1, 5))
@settings(max_examples=60, deadline=None)
def test_landmark_has_one_box_per_agent(seed: int, n: int, agents: int) -> None:
    rng = np.random.default_rng([seed, 4, 0])
    xy, agent = rng.uniform(0.0, 6.0, (n, 2)), rng.integers(agents, size=n)
    groups = landmarks(xy, agent)
    assert len(set().union(*groups)) == sum(map(len, groups))
    for group in groups:
        rows = sorted(group)
        assert len(rows) >= 2
        assert len(set(agent[rows].tolist())) == len(rows)
        gap = np.hypot(*(xy[rows][:, None] - xy[rows][None]).transpose(2, 0, 1)) + 9.0 * np.eye(len(rows))
        assert (gap.min(axis=1) <= 1.5).all()


@given(seed=st.integers(0, 10**6))
@settings(max_examples=20, deadline=None)
def test_without_conflicts_landmarks_are_the_connected_components(seed: int) -> None:
    """Every box of another agent: nothing stands against the closure."""
    rng = np.random.default_rng([seed, 5, 0])
    xy = rng.uniform(0.0, 12.0, (20, 2))
    reach = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1)) <= 1.5
    reach = np.linalg.matrix_power(reach.astype(float), 20) > 0
    expected = {frozenset(np.flatnonzero(row).tolist()) for row in reach if row.sum() > 1}
    assert {frozenset(group) for group in landmarks(xy, np.arange(20))} == expected


# Bad input


def test_declared_needs_are_those_used() -> None:
    observation = Observation(boxes=FOUR, pose=pose_of(CAR1))
    with pytest.raises(ValueError, match="CoAlign needs variance of every agent"):
        CoAlign().select_inputs(observation)
    with pytest.raises(ValueError, match="CoAlign needs pose of every agent"):
        CoAlign().select_inputs(Observation(boxes=FOUR, variance=np.ones((4, 3))))


@pytest.mark.parametrize(
    ("variance", "message"),
    [
        (np.ones((3, 3)), r"car2: variance must have shape \(4, 3\), got \(3, 3\)"),
        (np.ones((4, 3)) - np.eye(4)[:, 1:] * 1.0, "car2: variance: row 1 is not positive"),
        (np.ones((4, 3)) * [[1.0], [1.0], [np.nan], [1.0]], "car2: variance: row 2 is not positive"),
    ],
)
def test_bad_variances_are_named(variance: FloatArray, message: str) -> None:
    observations = {
        "car1": boxes_at(FOUR, CAR1),
        "car2": Observation(boxes=FOUR, variance=variance, pose=pose_of(CAR2)),
    }
    with pytest.raises(ValueError, match=message):
        CoAlign().align_group("car1", observations)


@pytest.mark.parametrize("options", [{"gate": 0.0}, {"gate": math.nan}, {"min_landmarks": 0}, {"max_yaw_variance": -1}])
def test_settings_are_checked(options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        group_aligner("coalign", **options)
