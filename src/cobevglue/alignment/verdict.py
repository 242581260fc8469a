"""The verdict: the probability that a pose is wrong.

The hypotheses of the filter and "the two agents have nothing in common" are taken for all there is: their evidences,
as log-likelihoods, make a posterior. A right hypothesis may still be imprecise, so the probability that it lands boxes
farther off than the tolerance is added.
"""

from __future__ import annotations

import math

from cobevglue.alignment.config import BEVGlueConfig

__all__ = ["explain_refusal", "landing_risk", "pose_risk"]

_UNMODELLED = 0.001
"""Least risk: what no model here knows of, such as objects with false positions in both lists."""


def pose_risk(evidence: float, margin: float, landing_std: float, config: BEVGlueConfig) -> float:
    """Estimated probability that a pose lands the other agent's boxes farther off than the tolerance.

    Args:
        evidence: of the best hypothesis [nats].
        margin: by how much that exceeds the evidence of the best different one [nats].
        landing_std: standard deviation of where the other's boxes land in the ego frame [m].
        config: gives the evidence of chance and the tolerance.
    """
    chance, second = _odds_against(evidence, margin, config)
    right = (1.0 - landing_risk(landing_std, config.tolerance)) / (1.0 + chance + second)
    return _UNMODELLED + (1.0 - _UNMODELLED) * (1.0 - right)


def landing_risk(landing_std: float, tolerance: float) -> float:
    """Probability that boxes land farther off than `tolerance` [m], of the right hypothesis (Rayleigh distribution)."""
    return math.exp(-0.5 * (tolerance / max(landing_std, 1e-3)) ** 2)


def explain_refusal(evidence: float, margin: float, landing_std: float, pairs: int, config: BEVGlueConfig) -> str:
    """Why a pose is refused, or an empty string if its risk is low enough.

    Args:
        evidence: see `pose_risk`.
        margin: likewise.
        landing_std: likewise.
        pairs: matched pairs in this frame.
        config: gives the accepted risk.
    """
    if pairs == 0:
        return "no object in this frame supports the pose followed so far"
    risk = pose_risk(evidence, margin, landing_std, config)
    if risk < config.risk:
        return ""
    chance, second = _odds_against(evidence, margin, config)
    imprecise = landing_risk(landing_std, config.tolerance)
    if imprecise >= max(chance, second):
        cause = f"too uncertain: boxes would land within {landing_std:.1f} m"
    elif chance >= second:
        cause = f"too few common objects: evidence {evidence:.1f} nats"
    else:
        cause = f"ambiguous: a different pose is only {margin:.1f} nats behind"
    return f"{cause}; risk {risk:.2g}, {config.risk:.2g} allowed"


def _odds_against(evidence: float, margin: float, config: BEVGlueConfig) -> tuple[float, float]:
    """Likelihoods of "nothing in common" and of the best different pose, relative to the best pose's."""
    return math.exp(min(config.chance_evidence - evidence, 500.0)), math.exp(-max(margin, -500.0))
