"""Which of the pairs' hypotheses are right, given all pairs of a group: exact search over few poses of each agent.

Every pair of agents hands over several hypotheses of its relative pose. The unknowns are the agents' poses in the frame
of agent 0. A combination of poses is scored by all pairs, whether or not they led to it:

    score = sum over pairs of log(1 + sum over the pair's hypotheses of exp(log_odds - d^2 / 2))

with d the Mahalanobis distance of the relative pose from the hypothesis: a mixture of the hypotheses and of "the two
lists have nothing in common". Around a loop of pairs d is the error of the loop. All combinations of the candidates
(`group_candidates`) are scored, so an agent that shares nothing with agent 0 comes in through a third.

A loop that does not close takes something away from the score, one that closes adds nothing. For the pairs are not
independent: three lists that show the same objects agree on a coincidence as well as on the truth. For the same reason
the probability that an agent is tied to agent 0 by coincidence is that of the most certain chain of pairs, not of all
chains together.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from cobevglue.alignment.group_candidates import (
    LEAST_LOG_ODDS,
    Candidates,
    PairHypotheses,
    path_candidates,
    same_pose,
)
from cobevglue.alignment.uncertain_poses import difference, relative
from cobevglue.typing import BoolArray, FloatArray, IntArray

__all__ = ["SAME_TURN", "SAME_WITHIN", "Configuration", "best_configuration"]

SAME_WITHIN, SAME_TURN = 2.0, math.radians(8.0)
"""Poses this close are not different answers [m, rad], as in `pose_search`."""
_MOST_CONFIGURATIONS = 20_000
"""Combinations kept while agent after agent is added: all of up to five agents with eleven candidates each."""
_LARGEST_EXPONENT = 500.0


@dataclass(frozen=True, slots=True, eq=False)
class Configuration:
    """The best poses of N agents in the frame of agent 0, and what speaks against them.

    Attributes:
        pose: (N, 3) x, y [m], yaw [rad]; NaN for an agent that no pair leads to.
        chosen: by pair, the row of the hypothesis that agrees with these poses; pairs without one are left out.
        coincidence: (N,) odds that the most certain chain of pairs to an agent rests on chance; inf without a chain.
        elsewhere: (N,) odds that the agent has a different pose.
        contested_by: (N,) the agent without which a different pose would be accepted; -1 for none.
    """

    pose: FloatArray
    chosen: dict[tuple[int, int], int]
    coincidence: FloatArray
    elsewhere: FloatArray
    contested_by: IntArray


@dataclass(frozen=True, slots=True, eq=False)
class _PairScores:
    """What a pair says of each combination, C x D of candidates or B of configurations.

    Attributes:
        score: [nats].
        row: of the hypothesis that agrees best, -1 for none.
        log_odds: of that one, less half its squared distance [nats].
        ambiguity: of that one [nats].
    """

    score: FloatArray
    row: IntArray
    log_odds: FloatArray
    ambiguity: FloatArray

    @classmethod
    def of(cls, a: Candidates, b: Candidates, pair: PairHypotheses) -> _PairScores:
        """(C, D) for C candidates of one agent and D of the other."""
        pose, covariance = relative(a.pose[:, None], a.covariance[:, None], b.pose, b.covariance)
        error = difference(pose[:, :, None], pair.pose)
        total = covariance[:, :, None] + pair.covariance
        squared = np.einsum("...i,...i", error, np.linalg.solve(total, error[..., None])[..., 0])
        log_odds = pair.log_odds - 0.5 * squared
        row = log_odds.argmax(axis=2)
        best = np.take_along_axis(log_odds, row[..., None], axis=2)[..., 0]
        agrees = best > LEAST_LOG_ODDS
        return cls(
            np.logaddexp.reduce(log_odds, axis=2, initial=0.0),
            np.where(agrees, row, -1),
            np.where(agrees, best, -np.inf),
            np.where(agrees, pair.ambiguity[row], 0.0),
        )

    def at(self, a: IntArray, b: IntArray) -> _PairScores:
        """(B,) for the candidates (B,) of the two agents in each configuration."""
        return _PairScores(self.score[a, b], self.row[a, b], self.log_odds[a, b], self.ambiguity[a, b])


def best_configuration(pairs: Mapping[tuple[int, int], PairHypotheses], agents: int, risk: float) -> Configuration:
    """The poses with the highest score.

    Args:
        pairs: for pairs (i, j), i < j < agents, the hypotheses of i_SE2_j.
        agents: how many there are.
        risk: accepted probability of a wrong pose, for `contested_by`.
    """
    candidates = path_candidates(pairs, agents)
    tables = {
        (i, j): _PairScores.of(candidates[i], candidates[j], pair)
        for (i, j), pair in pairs.items()
        if len(pair.log_odds) and len(candidates[i]) and len(candidates[j])
    }
    choice = _configurations([len(each) for each in candidates], {pair: table.score for pair, table in tables.items()})
    said = {(i, j): table.at(choice[:, i], choice[:, j]) for (i, j), table in tables.items()}
    total = _sum([each.score for each in said.values()], len(choice))
    best = int(total.argmax())
    result = Configuration(
        np.full((agents, 3), np.nan),
        {pair: int(each.row[best]) for pair, each in said.items() if each.row[best] >= 0},
        _coincidence({pair: float(each.log_odds[best]) for pair, each in said.items()}, agents),
        np.zeros(agents),
        np.full(agents, -1),
    )
    misled = _root_sum_square([np.where(_rivals(s, best), s.ambiguity, 0.0) for s in said.values()], len(choice))
    odds = total - total[best] + misled
    for k, found in enumerate(candidates):
        if not len(found):
            result.elsewhere[k] = np.inf
            continue
        result.pose[k] = found.pose[choice[best, k]]
        different = ~same_pose(found.pose, result.pose[k], SAME_WITHIN, SAME_TURN)
        alternatives = np.flatnonzero(different[choice[:, k]])
        if not len(alternatives):
            continue
        most = np.full(len(found), -np.inf)
        np.maximum.at(most, choice[alternatives, k], odds[alternatives])
        result.elsewhere[k] = np.exp(np.minimum(most, _LARGEST_EXPONENT)).sum()
        result.contested_by[k] = _contested_by(k, said, best, alternatives, risk)
    return result


def _configurations(counts: list[int], scores: Mapping[tuple[int, int], FloatArray]) -> IntArray:
    """(B, N) combinations of candidates, all or the best; 0 for agents that have none."""
    choice = np.zeros((1, len(counts)), np.int64)
    total = np.zeros(1)
    for k, count in enumerate(counts):
        if count < 2:
            continue
        extended = np.repeat(total[:, None], count, axis=1)
        for (i, j), score in scores.items():
            if j == k:
                extended += score[choice[:, i]]
        kept = np.arange(extended.size)
        if len(kept) > _MOST_CONFIGURATIONS:
            kept = np.argpartition(-extended, _MOST_CONFIGURATIONS, axis=None)[:_MOST_CONFIGURATIONS]
        before, chosen = np.divmod(kept, count)
        choice, total = choice[before], extended.ravel()[kept]
        choice[:, k] = chosen
    return choice


def _contested_by(
    k: int, said: Mapping[tuple[int, int], _PairScores], best: int, alternatives: IntArray, risk: float
) -> int:
    """The agent without which one of the alternatives would be accepted; -1 for none.

    So no single agent, whose boxes may be false, decides against what all others say.
    """
    for third in sorted({agent for pair in said for agent in pair} - {0, k}):
        rest = [each for pair, each in said.items() if third not in pair]
        lead = _sum([each.score[alternatives] - each.score[best] for each in rest], len(alternatives))
        misled = _root_sum_square(
            [np.where(_rivals(s, best)[alternatives], s.ambiguity[best], 0.0) for s in rest], len(alternatives)
        )
        if (lead - misled).max() > math.log((1.0 - risk) / risk):
            return third
    return -1


def _rivals(said: _PairScores, best: int) -> BoolArray:
    """(B,) in which configurations a pair agrees by another hypothesis than with the best one: by a regular pattern."""
    rivals: BoolArray = (said.row != said.row[best]) & (said.row >= 0) & (said.row[best] >= 0)
    return rivals


def _coincidence(log_odds: Mapping[tuple[int, int], float], agents: int) -> FloatArray:
    """(N,) odds that the most certain chain of pairs rests on chance: the shortest path, odds as lengths."""
    odds = np.full((agents, agents), np.inf)
    for (i, j), value in log_odds.items():
        odds[i, j] = odds[j, i] = math.exp(min(-value, _LARGEST_EXPONENT)) if value > -np.inf else np.inf
    chance = np.full(agents, np.inf)
    chance[0] = 0.0
    for _ in range(agents - 1):
        chance = np.minimum(chance, (chance[:, None] + odds).min(axis=0))
    return chance


def _sum(terms: list[FloatArray], count: int) -> FloatArray:
    return np.sum(terms, axis=0) if terms else np.zeros(count)


def _root_sum_square(terms: list[FloatArray], count: int) -> FloatArray:
    """Of errors that are independent from pair to pair."""
    root: FloatArray = np.sqrt(_sum([np.square(term) for term in terms], count))
    return root
