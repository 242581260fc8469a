"""Candidate poses of each agent of a group: hypotheses of pairs, composed along paths that start at agent 0."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cobevglue.alignment.hypotheses import PoseHypothesis
from cobevglue.alignment.uncertain_poses import compose, difference, invert, to_xyyaw
from cobevglue.typing import BoolArray, FloatArray, IntArray

__all__ = ["Candidates", "PairHypotheses", "path_candidates", "same_pose"]

_MOST_HYPOTHESES = 4
"""Of a pair that are used."""
LEAST_LOG_ODDS = -3.0
"""Of a hypothesis that is used [nats]."""
_MODEL_STD = (0.3, 0.3, math.radians(0.6))
"""Error of a hypothesis beyond its covariance, such as lists of different instants cause [m, m, rad]."""
_LONGEST_PATH = 3
"""Pairs in a path."""
_MOST_CANDIDATES = 12
"""Of an agent."""
_MERGED_WITHIN, _MERGED_TURN = 1.0, math.radians(3.0)
"""Candidates this close are one [m, rad]."""


@dataclass(frozen=True, slots=True, eq=False)
class PairHypotheses:
    """H hypotheses of a_SE2_b as arrays, best first, between the centres of the two agents' boxes.

    At the centres errors of the yaw have short arms, and first-order covariances suffice.

    Attributes:
        pose: (H, 3) x, y [m], yaw [rad].
        covariance: (H, 3, 3).
        log_odds: (H,) [nats].
        ambiguity: (H,) [nats].
    """

    pose: FloatArray
    covariance: FloatArray
    log_odds: FloatArray
    ambiguity: FloatArray

    @classmethod
    def of(cls, hypotheses: Sequence[PoseHypothesis], a_center: FloatArray, b_center: FloatArray) -> PairHypotheses:
        """The best hypotheses of a pair.

        Args:
            hypotheses: of a_SE2_b.
            a_center: (2,) in a's frame [m].
            b_center: (2,) in b's frame [m].
        """
        used = sorted((h for h in hypotheses if h.log_odds > LEAST_LOG_ODDS), key=lambda h: -h.log_odds)
        used = used[:_MOST_HYPOTHESES]
        pose = np.array([to_xyyaw(h.ego_SE2_other) for h in used]).reshape(-1, 3)
        covariance = np.array([h.covariance for h in used]).reshape(-1, 3, 3) + np.diag(np.square(_MODEL_STD))
        pose, covariance = compose(pose, covariance, np.array([*b_center, 0.0]), np.zeros((3, 3)))
        pose[:, :2] -= a_center
        return cls(pose, covariance, np.array([h.log_odds for h in used]), np.array([h.ambiguity for h in used]))

    def inverse(self) -> PairHypotheses:
        """The same of b_SE2_a."""
        return PairHypotheses(*invert(self.pose, self.covariance), self.log_odds, self.ambiguity)


@dataclass(frozen=True, slots=True, eq=False)
class Candidates:
    """C candidate poses of an agent in the frame of agent 0, most certain path first.

    Attributes:
        pose: (C, 3) x, y [m], yaw [rad].
        covariance: (C, 3, 3) of the path that leads there.
        log_odds: (C,) the least along that path [nats].
        visited: (C,) bit mask of the agents on that path.
    """

    pose: FloatArray
    covariance: FloatArray
    log_odds: FloatArray
    visited: IntArray

    def __len__(self) -> int:
        return len(self.log_odds)

    def __getitem__(self, rows: IntArray | BoolArray) -> Candidates:
        return Candidates(self.pose[rows], self.covariance[rows], self.log_odds[rows], self.visited[rows])

    @classmethod
    def origin(cls) -> Candidates:
        """Agent 0 itself."""
        return cls(np.zeros((1, 3)), np.zeros((1, 3, 3)), np.array([np.inf]), np.array([1]))

    @classmethod
    def merged(cls, parts: Sequence[Candidates]) -> Candidates:
        """All of them; of those that are close together the one of the most certain path."""
        fields = ("pose", "covariance", "log_odds", "visited")
        everything = cls(*(np.concatenate([getattr(part, name) for part in parts]) for name in fields))
        everything = everything[np.argsort(-everything.log_odds, kind="stable")]
        close = same_pose(everything.pose[:, None], everything.pose, _MERGED_WITHIN, _MERGED_TURN)
        left = np.ones(len(everything), np.bool_)
        kept: list[int] = []
        while left.any() and len(kept) < _MOST_CANDIDATES:
            kept.append(int(left.argmax()))
            left &= ~close[kept[-1]]
        return everything[np.array(kept, np.int64)]

    def followed_by(self, pair: PairHypotheses, agent: int) -> Candidates:
        """Each path that does not lead through `agent`, followed by each hypothesis of the pair that leads to it."""
        start = self[self.visited & (1 << agent) == 0]
        pose, covariance = compose(start.pose[:, None], start.covariance[:, None], pair.pose, pair.covariance)
        log_odds = np.minimum(start.log_odds[:, None], pair.log_odds)
        visited = np.broadcast_to(start.visited[:, None] | (1 << agent), log_odds.shape)
        return Candidates(pose.reshape(-1, 3), covariance.reshape(-1, 3, 3), log_odds.ravel(), visited.ravel())


def path_candidates(pairs: Mapping[tuple[int, int], PairHypotheses], agents: int) -> list[Candidates]:
    """The candidates of all agents.

    Args:
        pairs: for pairs (i, j), i < j, the hypotheses of i_SE2_j.
        agents: how many there are.

    Returns:
        Those of agents 0, 1, …; none for an agent that no path leads to.
    """
    steps = {pair: found for pair, found in pairs.items() if len(found.log_odds)}
    steps |= {(j, i): found.inverse() for (i, j), found in steps.items()}
    origin = Candidates.origin()
    nothing = origin[np.zeros(0, np.int64)]
    candidates = [origin] + [nothing] * (agents - 1)
    for _ in range(min(_LONGEST_PATH, agents - 1)):
        candidates = [origin] + [
            Candidates.merged(
                [candidates[i].followed_by(steps[i, k], k) for i in range(agents) if (i, k) in steps] or [nothing]
            )
            for k in range(1, agents)
        ]
    return candidates


def same_pose(a: FloatArray, b: FloatArray, within: float, turn: float) -> BoolArray:
    """Whether poses (..., 3) are less than `within` [m] and `turn` [rad] apart."""
    gap = difference(a, b)
    same: BoolArray = (np.hypot(gap[..., 0], gap[..., 1]) < within) & (np.abs(gap[..., 2]) < turn)
    return same
