"""Poses that are consistent among all pairs of agents."""

from __future__ import annotations

import subprocess
import sys

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cobevglue.alignment import ALIGNERS
from cobevglue.alignment.v2vnet_robust import V2VNetRobustPoses, consistent_poses, robust_mean
from cobevglue.se2 import SE2

AGENTS = [SE2(), SE2(20.0, 5.0, 0.4), SE2(-15.0, 8.0, -2.9), SE2(3.0, -25.0, 3.1)]
"""In the frame of the first."""
PAIRS = [(i, j) for i in range(4) for j in range(4) if i != j]
WRONG = SE2(8.0, -6.0, 0.9)


def true_pairs(agents: int = 4) -> dict[tuple[int, int], tuple[SE2, float]]:
    return {(i, j): (AGENTS[i].inverse() @ AGENTS[j], 0.5) for i, j in PAIRS if max(i, j) < agents}


def farthest(found: list[SE2]) -> tuple[float, float]:
    """The largest error of position [m] and heading [rad]."""
    errors = np.array([pose.error_to(true) for pose, true in zip(found, AGENTS, strict=False)])
    return float(errors[:, 0].max()), float(errors[:, 1].max())


@pytest.mark.parametrize("agents", [2, 3, 4])
def test_pairs_that_agree_give_the_poses_they_have(agents: int) -> None:
    found = consistent_poses(true_pairs(agents))
    assert len(found) == agents
    assert farthest(found) == pytest.approx((0.0, 0.0), abs=1e-6)


@pytest.mark.parametrize("wrong", PAIRS)
def test_one_wrong_direction_of_four_agents_is_outvoted(wrong: tuple[int, int]) -> None:
    pairs = true_pairs()
    pairs[wrong] = (WRONG @ pairs[wrong][0], 0.5)
    position, heading = farthest(consistent_poses(pairs))
    assert position < 0.05
    assert heading < 0.01


def test_both_directions_of_a_pair_may_be_wrong() -> None:
    """The ego and agent 1 are at odds, twice, and everybody else knows better."""
    pairs = true_pairs()
    for pair in [(0, 1), (1, 0)]:
        pairs[pair] = (WRONG @ pairs[pair][0], 0.5)
    position, heading = farthest(consistent_poses(pairs))
    assert position < 0.2
    assert heading < 0.02


def test_two_agents_meet_in_the_middle() -> None:
    """There are only two answers, and no reason to believe one more than the other."""
    pairs = {(0, 1): (SE2(10.0, 0.0, 0.1), 0.5), (1, 0): (SE2(10.4, 0.2, 0.1).inverse(), 0.5)}
    pose = consistent_poses(pairs)[1]
    np.testing.assert_allclose([pose.x, pose.y, pose.yaw], [10.2, 0.1, 0.1], atol=1e-6)


def test_a_pair_that_overlaps_more_counts_more() -> None:
    pairs = {(0, 1): (SE2(10.0, 0.0, 0.0), 0.9), (1, 0): (SE2(10.4, 0.0, 0.0).inverse(), 0.1)}
    assert 10.0 < consistent_poses(pairs)[1].x < 10.1


def test_robust_mean_ignores_outliers() -> None:
    near = [SE2(1.0 + 0.1 * i, 2.0, 0.5) for i in range(-2, 3)]
    mean = robust_mean([*near, SE2(30.0, -4.0, 2.0), SE2(31.0, -4.0, 2.0)], np.ones(7))
    assert mean.error_to(SE2(1.0, 2.0, 0.5)) == pytest.approx((0.0, 0.0), abs=0.05)


def test_mean_heading_is_right_across_the_cut() -> None:
    mean = robust_mean([SE2(0.0, 0.0, 3.1), SE2(0.0, 0.0, -3.1)], np.ones(2))
    assert abs(mean.yaw) == pytest.approx(np.pi, abs=1e-6)


def test_weights_of_0_are_no_weights() -> None:
    """Maps that do not overlap: no pair counts, and yet there has to be a pose."""
    poses = [SE2(1.0, 0.0, 0.0), SE2(2.0, 0.0, 0.0)]
    assert robust_mean(poses, np.zeros(2)).x == pytest.approx(robust_mean(poses, np.ones(2)).x)


_SMALL = st.floats(-0.3, 0.3)


@settings(max_examples=40, deadline=None)
@given(st.lists(st.tuples(_SMALL, _SMALL, st.floats(-0.02, 0.02)), min_size=12, max_size=12))
def test_error_of_mean_is_bounded_by_inputs(errors: list[tuple[float, float, float]]) -> None:
    pairs = {
        pair: (pose @ SE2(*error), weight)
        for (pair, (pose, weight)), error in zip(true_pairs().items(), errors, strict=True)
    }
    position, heading = farthest(consistent_poses(pairs))
    lever = 30.0 * 0.02  # a turn of another agent moves what it says of a third
    assert position <= 2.0 * (0.3 * np.sqrt(2.0) + lever)
    assert heading <= 0.06


def test_importing_aligners_does_not_import_torch() -> None:
    code = (
        "import sys; from cobevglue.alignment import ALIGNERS as a; print('v2vnet-robust' in a, 'torch' in sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["True", "False"]


def test_it_goes_by_the_name_that_users_type() -> None:
    assert ALIGNERS["v2vnet-robust"] is V2VNetRobustPoses
    assert V2VNetRobustPoses.needs == {"pose", "features"}
