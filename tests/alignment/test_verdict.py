"""The stated risk: a posterior over hypotheses and chance, and the tail of the landing error."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import norm

from cobevglue import BEVGlueConfig
from cobevglue.alignment.verdict import judge, landing_risk

CONFIG = BEVGlueConfig(chance_evidence=6.0, self_similarity=0.0, risk=0.05, tolerance=3.0)
SURE = 1e4
"""Evidence that leaves no doubt [nats]."""


@pytest.mark.parametrize(
    ("evidence", "margin", "landing_std", "risk", "reason"),
    [
        pytest.param(SURE, SURE, 0.1, 0.001, "", id="no doubt: the least risk remains"),
        pytest.param(6.0, 6.0, 0.1, 0.5, "too few common objects", id="as likely as chance"),
        pytest.param(SURE, 0.0, 0.1, 0.5, "ambiguous", id="a different pose is as likely"),
        pytest.param(SURE, math.log(99.0), 0.1, 0.011, "", id="a different pose is 99 times less likely"),
        pytest.param(SURE, SURE, 3.0, 0.3176, "too uncertain", id="the tolerance is one standard deviation"),
        pytest.param(6.0, 0.0, 0.1, 2 / 3, "too few common objects", id="chance and a different pose, equally"),
    ],
)
def test_risk_is_one_minus_posterior(
    evidence: float, margin: float, landing_std: float, risk: float, reason: str
) -> None:
    verdict = judge(evidence, margin, math.inf, landing_std, 3, 10, CONFIG)
    assert verdict.risk == pytest.approx(risk, abs=2e-3)
    assert verdict.reason.startswith(reason)
    assert bool(verdict.reason) is (verdict.risk >= CONFIG.risk)


def test_no_matched_pair_is_refused() -> None:
    verdict = judge(SURE, SURE, math.inf, 0.1, 0, 10, CONFIG)
    assert verdict.risk == 1.0
    assert verdict.reason


@pytest.mark.parametrize(
    ("frame_margin", "accepted"),
    [
        pytest.param(math.inf, True, id="no different pose"),
        pytest.param(-8.0, True, id="one frame of a queue fits another pose by chance"),
        pytest.param(-15.0, False, id="the frame turned by 12 degrees at once and fits the pose after that"),
    ],
)
def test_jump_of_the_frame_is_refused(frame_margin: float, accepted: bool) -> None:
    verdict = judge(SURE, SURE, frame_margin, 0.1, 3, 10, BEVGlueConfig())
    assert bool(verdict.reason) is not accepted
    assert verdict.reason.startswith("" if accepted else "a jump: a different pose fits this frame alone")


def test_regular_pattern_stays_ambiguous() -> None:
    """Eight of nine equal gaps also fit the pose shifted by one: the margin is 1/9 of the evidence."""
    config = BEVGlueConfig()
    assert judge(36.0, 4.0, math.inf, 0.3, 9, 100, config).reason.startswith("ambiguous")
    assert not judge(36.0, 30.0, math.inf, 0.3, 9, 100, config).reason


@given(st.floats(0.01, 20.0), st.floats(0.1, 10.0))
def test_landing_risk_is_normal_tail(landing_std: float, tolerance: float) -> None:
    assert landing_risk(landing_std, tolerance) == pytest.approx(2.0 * norm.sf(tolerance / landing_std), abs=1e-12)


@given(st.floats(-5.0, 60.0), st.floats(0.0, 60.0), st.floats(0.05, 5.0), st.integers(1, 100))
def test_more_evidence_never_raises_risk(evidence: float, margin: float, landing_std: float, frames: int) -> None:
    """With the same different pose, so that the margin grows by as much."""
    before = judge(evidence, margin, math.inf, landing_std, 3, frames, BEVGlueConfig()).risk
    after = judge(evidence + 1.0, margin + 1.0, math.inf, landing_std, 3, frames, BEVGlueConfig()).risk
    assert 0.0 < after <= before <= 1.0
