"""BEVGlue for three and more agents: the poses on which all pairs agree."""

from __future__ import annotations

import itertools
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from cobevglue.alignment.alignment import Alignment
from cobevglue.alignment.bevglue import BEVGlue
from cobevglue.alignment.config import BEVGlueConfig
from cobevglue.alignment.group import GroupAligner, Observation
from cobevglue.alignment.group_candidates import PairHypotheses, same_pose
from cobevglue.alignment.group_consistency import SAME_TURN, SAME_WITHIN, Configuration, best_configuration
from cobevglue.alignment.group_refinement import refine_poses
from cobevglue.alignment.max_consensus import mutual_nearest
from cobevglue.alignment.own_body import known_bodies
from cobevglue.alignment.uncertain_poses import compose, to_se2, to_xyyaw
from cobevglue.alignment.verdict import landing_risk
from cobevglue.boxes import Boxes
from cobevglue.se2 import SE2
from cobevglue.typing import FloatArray

__all__ = ["BEVGlueGroup"]

_MATCHED_WITHIN = 2.0
"""Boxes of the ego and of an agent that came in through others match within [m]."""


class BEVGlueGroup(GroupAligner):
    """Aligns every pair of agents by `BEVGlue` and keeps the poses that are consistent around the loops of pairs.

    The other agents' boxes reach the ego anyway, so the pairs among them need no further messages. With two agents it
    is `BEVGlue`. With more, a pair that is ambiguous by itself is decided by the others, an agent that shares no
    objects with the ego comes in through a third, and where pairs contradict each other, poses are refused that a
    single other agent decides.

    Args:
        config: of each pair; `risk` and `tolerance` hold for the group.

    Raises:
        ValueError: the method has no hypotheses (`BEVGlueConfig.paper()`).
    """

    needs = frozenset({"boxes"})
    accepts = frozenset({"body", "time"})

    def __init__(self, config: BEVGlueConfig | None = None) -> None:
        self.config = config or BEVGlueConfig()
        if self.config.method != "evidence":
            raise ValueError(f"config.method must be 'evidence' for a group, got {self.config.method!r}")
        self._aligners: dict[tuple[str, str], BEVGlue] = {}
        self._times: dict[tuple[str, str], float | None] = {}

    def align_group(
        self, ego: str, observations: Mapping[str, Observation], time: float | None = None
    ) -> dict[str, Alignment]:
        """The poses of all other agents at once.

        Alignments of agents that came in through others have no time offset and only the matches that lie close.
        """
        names = [ego, *sorted(name for name in observations if name != ego)]
        boxes = [_boxes(observations[name]) for name in names]
        direct: dict[int, Alignment] = {}
        pairs = {}
        center = [_center(each) for each in boxes]
        for i, j in itertools.combinations(range(len(names)), 2):
            aligner = self._aligners.setdefault((names[i], names[j]), BEVGlue(self.config))
            known: dict[str, Any] = known_bodies(observations[names[i]].body, observations[names[j]].body)
            if observations[names[j]].time is not None:
                known["other_time"] = observations[names[j]].time
            if i == 0:
                direct[j] = aligner.align(boxes[i], boxes[j], time, **known)
            else:
                own_time, pair = observations[names[i]].time, (names[i], names[j])
                if own_time is None or own_time != self._times.get(pair):  # else the last list again: nothing new
                    aligner.align(boxes[i], boxes[j], time if own_time is None else own_time, **known)
                self._times[pair] = own_time
            pairs[i, j] = PairHypotheses.of(aligner.hypotheses, center[i], center[j])
        if len(names) > 2:
            found = _poses(best_configuration(pairs, len(names), self.config.risk), pairs)
            direct = {k: self._judge(alignment, found[k], boxes[0], boxes[k], names) for k, alignment in direct.items()}
        return {name: direct[k] for k, name in enumerate(names) if name != ego}

    def reset(self) -> None:
        """Forget all frames."""
        self._aligners.clear()
        self._times.clear()

    def forget(self, agent: str) -> None:
        """Forget the pairs with this agent."""
        for pair in [pair for pair in self._aligners if agent in pair]:
            del self._aligners[pair]
            self._times.pop(pair, None)

    def _judge(self, direct: Alignment, found: _Pose, ego: Boxes, other: Boxes, names: list[str]) -> Alignment:
        """The alignment of an agent, from that with the ego alone and from the group's pose."""

        def refused(reason: str) -> Alignment:
            return Alignment.refused(reason, direct.evidence, direct.margin, max(direct.risk, self.config.risk))

        if not math.isfinite(found.coincidence):
            return refused(direct.reason or "no chain of pairs of agents leads to it")
        ego_center, other_center = _center(ego), _center(other)
        if direct.ego_SE2_other is not None:
            alone = _between_centers(to_xyyaw(direct.ego_SE2_other), ego_center, other_center)
            agrees = bool(same_pose(alone, found.pose, SAME_WITHIN, SAME_TURN))
        else:
            agrees = False
        if found.contested_by >= 0:
            return refused(f"other agents contradict what {names[found.contested_by]} reports")
        if agrees and found.elsewhere < self.config.risk / (1.0 - self.config.risk):
            return direct
        imprecise = landing_risk(_landing_std(found.covariance, other), self.config.tolerance)
        risk = 1.0 - (1.0 - imprecise) / (1.0 + found.coincidence + found.elsewhere)
        if not risk < self.config.risk:
            cause = "the group has a different pose, too" if found.elsewhere > found.coincidence else direct.reason
            return refused(cause or "too few objects in common with any agent")
        pose, covariance = compose(found.pose, found.covariance, np.array([*-other_center, 0.0]), np.zeros((3, 3)))
        pose[:2] += ego_center
        ego_SE2_other = to_se2(pose)
        matches = mutual_nearest(ego.center[:, :2], ego_SE2_other.apply(other.center[:, :2]), _MATCHED_WITHIN)
        return Alignment(ego_SE2_other, matches, covariance, "", direct.evidence, direct.margin, risk)


@dataclass(frozen=True, slots=True, eq=False)
class _Pose:
    """The group's pose of one agent between the centres of the ego's and its boxes; see `Configuration`."""

    pose: FloatArray
    covariance: FloatArray
    coincidence: float
    elsewhere: float
    contested_by: int


def _poses(best: Configuration, pairs: Mapping[tuple[int, int], PairHypotheses]) -> list[_Pose]:
    """The poses of all agents, refined where a chain of pairs leads to them."""
    pose, covariance = best.pose.copy(), np.full((len(best.pose), 3, 3), np.inf)
    tied = np.flatnonzero(np.isfinite(best.coincidence))
    if len(tied) > 1:
        place = {int(k): n for n, k in enumerate(tied)}
        edges = {
            (place[i], place[j]): (pairs[i, j].pose[row], pairs[i, j].covariance[row])
            for (i, j), row in best.chosen.items()
            if i in place and j in place
        }
        pose[tied], covariance[tied] = refine_poses(pose[tied], edges)
    return [
        _Pose(pose[k], covariance[k], best.coincidence[k], best.elsewhere[k], int(best.contested_by[k]))
        for k in range(len(pose))
    ]


def _boxes(observation: Observation) -> Boxes:
    assert observation.boxes is not None
    return observation.boxes


def _center(boxes: Boxes) -> FloatArray:
    """(2,) mean of the box centres; the origin without boxes."""
    center: FloatArray = boxes.center[:, :2].mean(axis=0) if len(boxes) else np.zeros(2)
    return center


def _between_centers(pose: FloatArray, ego_center: FloatArray, other_center: FloatArray) -> FloatArray:
    """(3,) ego_SE2_other with both frames moved to the centres of the boxes."""
    moved = to_xyyaw(to_se2(pose) @ SE2(*other_center))
    moved[:2] -= ego_center
    return moved


def _landing_std(covariance: FloatArray, boxes: Boxes) -> float:
    """Mean standard deviation of where boxes land [m], from the covariance at their centre."""
    squared_arm = ((boxes.center[:, :2] - _center(boxes)) ** 2).sum(axis=1)
    return float(np.sqrt(covariance[0, 0] + covariance[1, 1] + covariance[2, 2] * squared_arm).mean())
