"""The verdict: the probability that a pose is wrong.

The hypotheses of the filter and "the two agents have nothing in common" are taken as exhaustive: their evidences, as
log-likelihoods, give the posterior. A right hypothesis may still be imprecise, so the probability that it lands boxes
farther off than the tolerance is added.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from cobevglue.alignment.config import BEVGlueConfig

__all__ = ["Verdict", "judge", "landing_risk"]

_UNMODELLED = 0.001
"""Least risk: what no model here knows of, such as objects with false positions in both lists."""
_JUMP = 6.0
"""Evidence against a jump of the frame between two lists: a lost list, a jerk, a wrong heading of the frame [nats]."""
_LARGEST_EXPONENT = 500.0


@dataclass(frozen=True, slots=True)
class Verdict:
    """The risk of a pose, and why it is refused.

    Attributes:
        risk: estimated probability that the pose lands the other agent's boxes farther off than the tolerance.
        reason: why it is refused; "" if the risk is low enough.
    """

    risk: float
    reason: str


def judge(
    evidence: float,
    margin: float,
    frame_margin: float,
    landing_std: float,
    pairs: int,
    frames: int,
    config: BEVGlueConfig,
) -> Verdict:
    """The verdict on the best hypothesis.

    Args:
        evidence: of the hypothesis [nats].
        margin: by how much that exceeds the evidence of the best different one [nats].
        frame_margin: the same of the evidence of this frame alone.
        landing_std: standard deviation of where the other's boxes land in the ego frame [m].
        pairs: that it matches in this frame.
        frames: that were seen so far, this one included.
        config: gives the accepted risk and the parameters of the posterior.
    """
    if pairs == 0:
        return Verdict(1.0, "no object in this frame supports the pose followed so far")
    chance = _likelihood(config.chance_evidence - evidence)
    # Where a different pose has much evidence, too, the pattern is regular, and the agents may see different parts of
    # what looks alike: then the margin only decides between these parts. A single frame cannot exclude that; frames in
    # which objects move can.
    alike = config.self_similarity * (1.0 + 1.0 / frames) * max(evidence - margin, 0.0)
    second = _likelihood(alike - margin)
    # The frame may have moved otherwise than the hypothesis expects. Then another pose explains this frame far better
    # than the one followed, and better than a pose of nothing in common does by chance.
    jumped = _likelihood(-frame_margin - config.chance_evidence - _JUMP)
    imprecise = landing_risk(landing_std, config.tolerance)
    risk = _UNMODELLED + (1.0 - _UNMODELLED) * (1.0 - (1.0 - imprecise) / (1.0 + chance + second + jumped))
    if risk < config.risk:
        return Verdict(risk, "")
    if jumped >= max(chance, second, imprecise):
        cause = f"a jump: a different pose fits this frame alone better by {-frame_margin:.1f} nats"
    elif imprecise >= max(chance, second):
        cause = f"too uncertain: boxes would land within {landing_std:.1f} m"
    elif chance >= second:
        cause = f"too few common objects: evidence {evidence:.1f} nats"
    else:
        cause = f"ambiguous: a different pose is only {margin:.1f} nats behind"
    return Verdict(risk, f"{cause}; risk {risk:.2g}, {config.risk:.2g} allowed")


def landing_risk(landing_std: float, tolerance: float) -> float:
    """Probability that boxes land farther off than `tolerance` [m] under the right hypothesis.

    Normal in one direction, since one dominates as a rule: along the motion if the time offset is uncertain, across
    the line of sight if the yaw is.
    """
    return math.erfc(tolerance / (math.sqrt(2.0) * max(landing_std, 1e-3)))


def _likelihood(log_ratio: float) -> float:
    """Of an alternative, relative to the best hypothesis'."""
    return math.exp(min(log_ratio, _LARGEST_EXPONENT))
