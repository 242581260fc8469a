"""Which hypotheses of the pairs are chosen: hand-made groups, and a search through all combinations."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest

from cobevglue import SE2
from cobevglue.alignment import PoseHypothesis
from cobevglue.alignment.group_candidates import PairHypotheses, path_candidates
from cobevglue.alignment.group_consistency import Configuration, best_configuration
from cobevglue.alignment.group_refinement import refine_poses
from cobevglue.alignment.uncertain_poses import relative_pose, to_se2, to_xyyaw
from cobevglue.typing import FloatArray

POSES = [SE2(), SE2(20.0, 5.0, 1.0), SE2(-10.0, 30.0, -2.0), SE2(35.0, -20.0, 0.4), SE2(15.0, 40.0, 3.0)]
COVARIANCE = np.diag([0.04, 0.04, math.radians(0.5) ** 2])
SHIFT = SE2(25.0, 0.0, 0.0)
RISK = 0.05

Told = dict[tuple[int, int], list[tuple[SE2, float]]]


def right(i: int, j: int) -> SE2:
    return POSES[i].inverse() @ POSES[j]


def wrong(i: int, j: int) -> SE2:
    """25 m off, as in a regular car park."""
    return right(i, j) @ SHIFT


def best(told: Told, agents: int, ambiguity: float = 0.0) -> Configuration:
    return best_configuration(arrays(told, ambiguity), agents, RISK)


def arrays(told: Told, ambiguity: float = 0.0) -> dict[tuple[int, int], PairHypotheses]:
    return {
        pair: PairHypotheses.of([PoseHypothesis(p, COVARIANCE, odds, ambiguity) for p, odds in each], *np.zeros((2, 2)))
        for pair, each in told.items()
    }


def off(found: Configuration, k: int) -> float:
    return to_se2(found.pose[k]).error_to(POSES[k])[0]


def test_loop_decides_between_two_equal_hypotheses() -> None:
    told = {
        (0, 1): [(right(0, 1), 15.0)],
        (1, 2): [(right(1, 2), 15.0)],
        (0, 2): [(wrong(0, 2), 20.0), (right(0, 2), 20.0)],
    }
    found = best(told, 3)
    assert off(found, 2) < 0.1
    assert found.chosen == {(0, 1): 0, (1, 2): 0, (0, 2): 1}
    assert found.elsewhere[2] < 1e-5
    assert found.coincidence[2] < 1e-6
    assert found.contested_by.tolist() == [-1, -1, -1]


def test_alone_the_same_pair_is_undecided() -> None:
    found = best({(0, 1): [(wrong(0, 1), 20.0), (right(0, 1), 20.0)]}, 2)
    assert found.elsewhere[1] == pytest.approx(1.0)


def test_two_agents_are_judged_by_their_margin() -> None:
    found = best({(0, 1): [(right(0, 1), 12.0), (wrong(0, 1), 7.0)]}, 2, ambiguity=2.0)
    assert found.coincidence[1] == pytest.approx(math.exp(-12.0), rel=1e-3)
    assert found.elsewhere[1] == pytest.approx(math.exp(7.0 - 12.0 + 2.0), rel=1e-2)


def test_agent_comes_in_through_a_third() -> None:
    found = best({(0, 1): [(right(0, 1), 12.0)], (1, 2): [(right(1, 2), 10.0)], (0, 2): []}, 3)
    assert off(found, 2) < 0.1
    assert found.coincidence[2] == pytest.approx(math.exp(-12.0) + math.exp(-10.0))


def test_chain_of_three_pairs_reaches_the_last() -> None:
    told = {(0, 3): [(right(0, 3), 12.0)], (2, 3): [(right(2, 3), 12.0)], (1, 2): [(right(1, 2), 12.0)]}
    found = best(told, 4)
    assert off(found, 1) < 0.1
    assert found.coincidence[1] == pytest.approx(3.0 * math.exp(-12.0))


def test_agent_without_hypotheses_has_no_pose() -> None:
    found = best({(0, 1): [(right(0, 1), 12.0)], (0, 2): [], (1, 2): []}, 3)
    assert np.isnan(found.pose[2]).all()
    assert found.coincidence[2] == math.inf
    assert off(found, 1) < 0.1


def test_closed_loop_of_weak_pairs_is_no_proof() -> None:
    """Three lists of the same objects agree on a coincidence, too."""
    told = {(0, 1): [(right(0, 1), 20.0)], (1, 2): [(right(1, 2), 0.0)], (0, 2): [(right(0, 2), 0.0)]}
    assert best(told, 3).coincidence[2] == pytest.approx(1.0)


def test_one_wrong_pair_among_five_agents_is_outvoted() -> None:
    told: Told = {(i, j): [(right(i, j), 15.0)] for i, j in itertools.combinations(range(5), 2)}
    told[0, 3] = [(wrong(0, 3), 18.0)]
    found = best(told, 5)
    for k in range(1, 5):
        assert off(found, k) < 0.1
        assert found.elsewhere[k] < 1e-4
    assert (0, 3) not in found.chosen
    assert found.contested_by.tolist() == [-1] * 5


def test_one_third_does_not_overrule_a_certain_pair() -> None:
    """Its boxes may be false: without it the pair would have been accepted elsewhere."""
    told = {(0, 1): [(right(0, 1), 40.0)], (1, 2): [(wrong(1, 2), 40.0)], (0, 2): [(right(0, 2), 20.0)]}
    assert best(told, 3).contested_by[2] == 1


def test_ambiguity_adds_as_the_root_of_squares() -> None:
    told: Told = {(0, 1): [(right(0, 1), 30.0)]}
    told |= {(i, 2): [(right(i, 2), 30.0), (POSES[i].inverse() @ POSES[2] @ SHIFT, 24.0)] for i in (0, 1)}
    expected = math.exp(2.0 * (24.0 - 30.0) + math.sqrt(2.0) * 8.0)
    assert best(told, 3, ambiguity=8.0).elsewhere[2] == pytest.approx(expected, rel=1e-3)


@pytest.mark.parametrize("seed", range(8))
def test_score_is_the_best_of_all_combinations(seed: int) -> None:
    """Against a plain search through all candidates, one combination at a time."""
    rng = np.random.default_rng(seed)
    agents = 4
    told: Told = {}
    for i, j in itertools.combinations(range(agents), 2):
        choices = [
            right(i, j),
            wrong(i, j),
            SE2(rng.uniform(-40.0, 40.0), rng.uniform(-40.0, 40.0), rng.uniform(-3.0, 3.0)),
        ]
        told[i, j] = [(pose, rng.uniform(-2.0, 20.0)) for pose in choices if rng.random() < 0.7]
    pairs = arrays(told)
    candidates = path_candidates(pairs, agents)

    def score(choice: tuple[int, ...]) -> float:
        total = 0.0
        for (i, j), pair in pairs.items():
            a, b = candidates[i], candidates[j]
            if not len(a) or not len(b):
                continue
            terms = 1.0
            for h in range(len(pair.log_odds)):
                terms += math.exp(pair.log_odds[h] - 0.5 * squared_distance(a, choice[i], b, choice[j], pair, h))
            total += math.log(terms)
        return total

    counts = [range(max(len(each), 1)) for each in candidates]
    top = max(itertools.product(*counts), key=score)
    found = best_configuration(pairs, agents, RISK)
    for k in range(agents):
        if len(candidates[k]):
            np.testing.assert_allclose(found.pose[k], candidates[k].pose[top[k]])


def squared_distance(a: object, row: int, b: object, column: int, pair: PairHypotheses, h: int) -> float:
    """Of the relative pose from a hypothesis, with numerical derivatives."""

    def at(x: FloatArray) -> FloatArray:
        return relative_pose(x[:3], x[3:])

    x = np.concatenate([a.pose[row], b.pose[column]])  # type: ignore[attr-defined]
    jacobian = np.column_stack([(at(x + step) - at(x - step)) / 2e-6 for step in 1e-6 * np.eye(6)])
    spread = np.zeros((6, 6))
    spread[:3, :3], spread[3:, 3:] = a.covariance[row], b.covariance[column]  # type: ignore[attr-defined]
    error = at(x) - pair.pose[h]
    error[2] = (error[2] + math.pi) % (2.0 * math.pi) - math.pi
    return float(error @ np.linalg.solve(jacobian @ spread @ jacobian.T + pair.covariance[h], error))


def test_refined_pose_is_the_weighted_mean() -> None:
    """One agent twice as certain directly as through a third."""
    edges = {
        (0, 1): (np.array([10.0, 0.0, 0.0]), np.eye(3) * 0.01),
        (1, 2): (np.array([10.0, 0.0, 0.0]), np.eye(3) * 0.01),
        (0, 2): (np.array([20.3, 0.0, 0.0]), np.eye(3) * 0.01),
    }
    pose, covariance = refine_poses(np.array([[0.0] * 3, [10.0, 0.0, 0.0], [20.0, 0.0, 0.0]]), edges)
    np.testing.assert_allclose(pose[:, 0], [0.0, 10.1, 20.2], atol=1e-6)
    # Three pairs on two agents: the variance of independent pairs, 2/3 of 0.01, times 3/2.
    assert covariance[2, 0, 0] == pytest.approx(0.01, rel=1e-6)
    assert not covariance[0].any()


def test_refinement_recovers_exact_poses() -> None:
    edges = {(i, j): (to_xyyaw(right(i, j)), COVARIANCE) for i, j in itertools.combinations(range(5), 2)}
    start = np.array([to_xyyaw(pose) for pose in POSES])
    start[1:] += (0.3, -0.4, 0.02)
    pose, _ = refine_poses(start, edges)
    np.testing.assert_allclose(pose, [to_xyyaw(pose) for pose in POSES], atol=1e-6)
