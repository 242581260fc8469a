"""FPV-RCNN's correction: what the search finds, and when the claimed pose stays."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cobevglue import SE2, Boxes
from cobevglue.alignment import Observation, group_aligner
from cobevglue.alignment.max_consensus import MaximumConsensus, mutual_nearest
from cobevglue.typing import FloatArray

from .observations import align, boxes_at, error
from .scenes import Pair, cars, error_at, pair_of_views, pairs_of

EXACT = (0.0, 0.0, 0.0, 0.0)


def corrected(pair: Pair, off: SE2, aligner: MaximumConsensus | None = None) -> tuple[SE2 | None, set[tuple[int, int]]]:
    """What comes of a claimed pose that is `off`, and the matches."""
    observations = {
        "ego": boxes_at(pair.ego, SE2(), None),
        "other": boxes_at(pair.other, pair.ego_SE2_other @ off, None),
    }
    found = align(aligner or MaximumConsensus(), observations)["other"]
    return found.ego_SE2_other, pairs_of(found)


@given(seed=st.integers(0, 10**6), x=st.floats(-2.1, 2.1), y=st.floats(-2.1, 2.1), yaw=st.floats(-3.0, 3.0))
@settings(max_examples=30, deadline=None)
def test_errors_within_the_window_are_repaired(seed: int, x: float, y: float, yaw: float) -> None:
    """Exact boxes near both agents: every common box agrees at the nearest grid point, and the fit is exact."""
    pair = pair_of_views(8, seed, 3, 3, noise=EXACT, reach=20.0)
    off = SE2(x, y, math.radians(yaw)).inverse()
    # The search turns about the other agent. With its frame in the middle of the boxes the grid is fine enough.
    centre = SE2(*pair.other.center[:, :2].mean(axis=0))
    pair = Pair(pair.ego, pair.other.transform(centre.inverse()), pair.ego_SE2_other @ centre, pair.matches)
    pose, matches = corrected(pair, off)
    assert error_at(pose, pair.ego_SE2_other, pair.other) < 1e-6
    assert matches == pairs_of_true(pair)


def pairs_of_true(pair: Pair) -> set[tuple[int, int]]:
    return {(int(m), int(k)) for m, k in pair.matches}


def test_detection_errors_average_out() -> None:
    for seed in range(10):
        pair = pair_of_views(10, seed, 4, 4, reach=25.0)
        pose, matches = corrected(pair, SE2(1.3, -0.9, math.radians(1.2)))
        assert error_at(pose, pair.ego_SE2_other, pair.other) < 0.5, seed
        assert len(matches & pairs_of_true(pair)) >= 8, seed


def test_errors_beyond_the_window_stay() -> None:
    """A regular car park would agree with any shift; here nothing else agrees, so what was claimed is kept."""
    pair = pair_of_views(6, 3, noise=EXACT)
    for off in (SE2(20.0, 0.0, 0.0), SE2(0.0, 0.0, math.radians(30.0))):
        pose, matches = corrected(pair, off)
        assert pose is not None
        assert pose.error_to(pair.ego_SE2_other @ off) == pytest.approx((0.0, 0.0), abs=1e-9)
        assert matches == set()


@pytest.mark.parametrize(("common", "repaired"), [(5, True), (6, True), (4, False), (1, False), (0, False)])
def test_so_many_boxes_have_to_agree(common: int, repaired: bool) -> None:
    pair = pair_of_views(6, 3, noise=EXACT)
    rows = pair.matches[:common]
    pair = Pair(
        pair.ego[rows[:, 0]], pair.other[rows[:, 1]], pair.ego_SE2_other, np.tile(np.arange(common)[:, None], 2)
    )
    off = SE2(1.0, 0.5, 0.0)
    pose, matches = corrected(pair, off, MaximumConsensus(min_consensus=5))
    assert pose is not None
    expected = pair.ego_SE2_other if repaired else pair.ego_SE2_other @ off
    assert pose.error_to(expected) == pytest.approx((0.0, 0.0), abs=1e-4)
    assert len(matches) == (common if repaired else 0)


def test_collaborators_are_corrected_each_by_itself() -> None:
    one, two = pair_of_views(8, 5, noise=EXACT), pair_of_views(8, 6, noise=EXACT)
    world = {
        "ego": boxes_at(one.ego, SE2(), None),
        "one": boxes_at(one.other, one.ego_SE2_other @ SE2(1.0, 0.0, 0.0), None),
        "two": boxes_at(two.other, two.ego_SE2_other, None),
    }
    found = align(MaximumConsensus(), world)
    assert error(found["one"], one.ego_SE2_other) == pytest.approx((0.0, 0.0), abs=1e-4)
    assert error(found["two"], two.ego_SE2_other) == pytest.approx((0.0, 0.0), abs=1e-4)
    assert len(found["one"].matches) == 8
    assert len(found["two"].matches) == 0


def best_by_brute_force(ego: FloatArray, other: FloatArray, claimed: SE2) -> int:
    """The largest consensus in a window of 1 m and 1 degree, by loops."""
    steps, turns = (-1.0, -0.5, 0.0, 0.5, 1.0), (-1.0, 0.0, 1.0)
    best = 0
    for x, y, turn in itertools.product(steps, steps, turns):
        moved = (SE2(x, y) @ claimed @ SE2(yaw=math.radians(turn))).apply(other)
        best = max(best, sum(any(math.dist(p, q) <= 1.0 for q in ego) for p in moved))
    return best


@pytest.mark.parametrize("seed", range(15))
def test_the_search_finds_the_largest_consensus(seed: int) -> None:
    """Boxes without rhyme or reason, so that no grid point is favoured."""
    rng = np.random.default_rng([seed, 0, 0])
    ego, other = rng.uniform(-8.0, 8.0, (9, 2)), rng.uniform(-8.0, 8.0, (11, 2))
    claimed = SE2(0.3, -0.2, 0.1)
    found = MaximumConsensus(shift=1.0, turn=math.radians(1.0))._most_agreed(ego, other, claimed)
    count = sum(any(math.dist(p, q) <= 1.0 for q in ego) for p in found.apply(other))
    assert count == best_by_brute_force(ego, other, claimed)


def test_ties_prefer_nearer_pairs_then_smaller_shift() -> None:
    search = MaximumConsensus(shift=2.0, turn=0.0)
    at = np.array([[0.0, 0.0], [10.0, 0.0]])
    assert search._most_agreed(at, at + (1.0, 0.5), SE2()) == SE2(-1.0, -0.5)
    assert search._most_agreed(at, at, SE2()) == SE2()
    # Both a step to the left and one to the right would bring a box onto one of the ego's.
    assert search._most_agreed(at[:1], np.array([[0.5, 0.0], [-2.0, 0.0]]), SE2()).x == -0.5


def test_matches_are_mutual() -> None:
    """Two boxes of other near one of ego: the nearer has it."""
    ego, other = np.array([[0.0, 0.0], [5.0, 0.0]]), np.array([[0.6, 0.0], [-0.2, 0.0], [5.0, 1.5]])
    assert mutual_nearest(ego, other, 1.0).tolist() == [[0, 1]]
    assert mutual_nearest(ego, other, 1.6).tolist() == [[0, 1], [1, 2]]
    assert mutual_nearest(ego[:0], other, 1.0).shape == (0, 2)
    assert mutual_nearest(ego, other[:0], 1.0).shape == (0, 2)


@pytest.mark.parametrize(("ego", "other"), [(0, 0), (0, 3), (3, 0), (1, 1)])
def test_next_to_no_boxes_leave_the_claimed_pose(ego: int, other: int) -> None:
    row = cars([(10, 0, 0), (20, 5, 90), (30, -5, 45)])
    found = align(
        MaximumConsensus(), {"a": boxes_at(row[:ego], SE2(), None), "b": boxes_at(row[:other], SE2(1.0, 0.0), None)}
    )
    assert error(found["b"], SE2(1.0, 0.0)) == pytest.approx((0.0, 0.0), abs=1e-9)


def test_it_asks_for_a_pose() -> None:
    with pytest.raises(ValueError, match="MaximumConsensus needs pose of every agent"):
        MaximumConsensus().select_inputs(Observation(boxes=Boxes.empty()))


@pytest.mark.parametrize(
    "options", [{"shift": -1.0}, {"turn": math.nan}, {"distance": 0.0}, {"min_consensus": 1}, {"shift": 1e9}]
)
def test_settings_are_checked(options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        group_aligner("fpv-rcnn", **options)
