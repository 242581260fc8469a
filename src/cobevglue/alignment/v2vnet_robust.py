"""V2VNet-robust's source of poses: claimed ones, corrected by what agents see, and made consistent among all of them.

Vadivelu et al., "Learning to Communicate and Correct Pose Errors", CoRL 2020. The network that corrects is part of
`cobevglue.fusion.v2vnet_robust`, and needs PyTorch; what is here makes its answers consistent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from cobevglue.alignment.alignment import Alignment
from cobevglue.alignment.group import GroupAligner, Observation
from cobevglue.datasets.poses import inverse_SE3
from cobevglue.se2 import SE2
from cobevglue.typing import FloatArray

if TYPE_CHECKING:
    from cobevglue.fusion.v2vnet_robust import V2VNetRobust

__all__ = ["V2VNetRobustPoses", "consistent_poses", "robust_mean"]

_LEVER = 10.0
"""Headings are compared by how far they move a point at this distance [m]."""
_DEGREES_OF_FREEDOM = 2.0
"""Of Student's t distribution: few, so that a far outlier counts next to nothing."""
_LEAST_VARIANCE = 0.05
"""Of a corrected pose [m^2]: no few answers that happen to agree are taken for certain."""
_SWEEPS, _STEPS = 10, 15
"""Over all agents, and of each robust mean."""


class V2VNetRobustPoses(GroupAligner):
    """Claimed poses, corrected pair by pair and made consistent. Never refused: far-off claims stay far off.

    Args:
        fusion: whose network corrects; None for the one that comes with the package for the detector "compact", which
            is loaded when it is first needed.
        iterations: how often each pair is corrected.
    """

    needs = frozenset({"pose", "features"})

    def __init__(self, fusion: V2VNetRobust | None = None, iterations: int = 3) -> None:
        self._fusion = fusion
        self._iterations = iterations

    def align_group(
        self, ego: str, observations: Mapping[str, Observation], time: float | None = None
    ) -> dict[str, Alignment]:
        """The poses that fit the corrected relative poses of all pairs of agents best."""
        names = [ego, *(name for name in observations if name != ego)]
        if len(names) == 1:
            return {}
        features, poses = [], []
        for name in names:
            seen = observations[name]
            assert seen.features is not None
            assert seen.pose is not None
            features.append(seen.features)
            poses.append(seen.pose)
        believed = {
            (i, j): SE2.from_matrix(inverse_SE3(poses[i]) @ poses[j])
            for i in range(len(names))
            for j in range(len(names))
            if i != j
        }
        found = consistent_poses(self._network().correct(features, believed, self._iterations))
        return {name: Alignment(found[number]) for number, name in enumerate(names) if number}

    def _network(self) -> V2VNetRobust:
        if self._fusion is None:
            from cobevglue.fusion import pretrained_fusion
            from cobevglue.fusion.v2vnet_robust import V2VNetRobust
            from cobevglue.perception import PointPillars

            fusion = pretrained_fusion("v2vnet-robust", PointPillars.pretrained("compact"), "compact")
            assert isinstance(fusion, V2VNetRobust)
            self._fusion = fusion
        return self._fusion


def consistent_poses(pairs: Mapping[tuple[int, int], tuple[SE2, float]]) -> list[SE2]:
    """Poses of n agents that fit the relative poses of their pairs, some of which may be wrong.

    One agent after the other is put to the robust mean of where all others, wherever they are by now, have it: by the
    pose that each found of it, and by the inverse of what it found of each (section 3.2 of the paper, where all agents
    move; here agent 0 stays, as only relative poses matter).

    Args:
        pairs: first_SE2_second and how much the pair counts, for all pairs of agents in both directions.

    Returns:
        n poses in the frame of agent 0, the first of them the identity.
    """
    agents = sorted({agent for pair in pairs for agent in pair})
    poses = [SE2(), *(pairs[0, agent][0] for agent in agents[1:])]
    for _ in range(_SWEEPS):
        for agent in agents[1:]:
            proposals, weights = [], []
            for other in agents:
                if other != agent:
                    (forth, weight), (back, back_weight) = pairs[other, agent], pairs[agent, other]
                    proposals += [poses[other] @ forth, poses[other] @ back.inverse()]
                    weights += [weight, back_weight]
            poses[agent] = robust_mean(proposals, np.array(weights))
    return poses


def robust_mean(poses: Sequence[SE2], weights: FloatArray) -> SE2:
    """The centre of Student's t distribution that fits some poses best, found by expectation maximisation.

    A pose is a point in four dimensions: x, y, and where the heading points to, 10 m away. All four have one variance:
    the paper has a covariance, which two to six points, one of which may be wrong, do not determine.

    Args:
        poses: K of them, in one frame.
        weights: (K,) how much each counts; all count the same where they are all 0.
    """
    points = np.array([[p.x, p.y, _LEVER * np.cos(p.yaw), _LEVER * np.sin(p.yaw)] for p in poses])
    weights = weights / weights.sum() if weights.sum() > 0.0 else np.full(len(points), 1.0 / len(points))
    centre, variance = np.median(points, axis=0), 1.0
    for _ in range(_STEPS):
        squares = ((points - centre) ** 2).sum(axis=1)
        scales = weights * (_DEGREES_OF_FREEDOM + 4.0) / (_DEGREES_OF_FREEDOM + squares / variance)
        centre = scales @ points / scales.sum()
        variance = scales @ ((points - centre) ** 2).sum(axis=1) / 4.0 + _LEAST_VARIANCE
    x, y, cos, sin = centre
    return SE2(x, y, np.arctan2(sin, cos))
