"""Hypotheses of a relative pose: what a pair of agents hands over where several poses fit its two lists."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from cobevglue.alignment.config import BEVGlueConfig
from cobevglue.se2 import SE2
from cobevglue.typing import FloatArray

__all__ = ["PoseHypothesis", "from_records"]


@dataclass(frozen=True, slots=True, eq=False)
class PoseHypothesis:
    """One of several relative poses that fit the lists of two agents.

    Attributes:
        ego_SE2_other: maps the other agent's coordinates into ego's.
        covariance: (3, 3) of its x [m], y [m] and yaw [rad].
        log_odds: of this hypothesis against "the two lists have nothing in common" [nats].
        ambiguity: part of `log_odds` that a regular pattern, such as a row of parked cars, may give to this pose
            without it being right: another hypothesis whose log odds are higher by less does not count as better
            [nats].
    """

    ego_SE2_other: SE2
    covariance: FloatArray
    log_odds: float
    ambiguity: float = 0.0


def from_records(records: NDArray[Any], frames: int, config: BEVGlueConfig) -> tuple[PoseHypothesis, ...]:
    """The hypotheses of the filter that objects of the present frame support, best first.

    Args:
        records: (H,) `pose_filter.HYPOTHESIS` records, best first.
        frames: seen so far.
        config: gives the evidence of chance and the share that regular patterns have in common.
    """
    records = records[records["pairs"] > 0]
    yaw = records["yaw"]
    cos, sin = np.cos(yaw), np.sin(yaw)
    arm_x = cos * records["other_x"] - sin * records["other_y"]
    arm_y = sin * records["other_x"] + cos * records["other_y"]
    at_origin = np.zeros((len(records), 3, 3))  # the records describe the pose at a pivot
    at_origin[:, [0, 1, 2], [0, 1, 2]] = 1.0
    at_origin[:, 0, 2], at_origin[:, 1, 2] = arm_y, -arm_x
    covariance = at_origin @ records["cov"][:, :3, :3] @ at_origin.transpose(0, 2, 1)
    x, y = records["ego_x"] - arm_x, records["ego_y"] - arm_y

    log_odds = records["evidence"] - config.chance_evidence
    ambiguity = config.self_similarity * (1.0 + 1.0 / max(frames, 1)) * np.maximum(records["evidence"], 0.0)
    return tuple(
        PoseHypothesis(SE2(x[i], y[i], yaw[i]), covariance[i], float(log_odds[i]), float(ambiguity[i]))
        for i in range(len(records))
    )
