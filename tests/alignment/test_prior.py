"""A claimed pose: one more pose to try, which never decides."""

from __future__ import annotations

import numpy as np
import pytest

from cobevglue import SE2, BEVGlue

from .scenes import drive, error_at

pytestmark = pytest.mark.usefixtures("warm_kernels")

COVARIANCE = np.diag([0.5**2, 0.5**2, 0.02**2])


@pytest.mark.parametrize("lie", [SE2(20.0, 0.0, 0.0), SE2(0.0, -20.0, 0.0), SE2(3.0, 3.0, 0.5), SE2(0.0, 0.0, np.pi)])
def test_false_claim_does_no_harm(lie: SE2) -> None:
    """A confident claim that is false: as many right poses as without it, and none that is wrong."""
    right = {"without": 0, "with": 0}
    for seed in range(6):
        frames = drive(common=5, seed=seed)
        without, claimed = BEVGlue(), BEVGlue()
        for frame in frames:
            for name, alignment in (
                ("without", without.align(frame.ego, frame.other)),
                ("with", claimed.align(frame.ego, frame.other, prior=(frame.ego_SE2_other @ lie, COVARIANCE))),
            ):
                if alignment.accepted:
                    assert error_at(alignment.ego_SE2_other, frame.ego_SE2_other, frame.other) < 3.0
                    right[name] += 1
    assert right["with"] >= 0.97 * right["without"] > 0


def test_true_claim_lowers_risk() -> None:
    frames = drive(common=3, seed=2)
    without, claimed = BEVGlue(), BEVGlue()
    risks = [
        (
            without.align(frame.ego, frame.other).risk,
            claimed.align(frame.ego, frame.other, prior=(frame.ego_SE2_other, COVARIANCE)).risk,
        )
        for frame in frames
    ]
    assert np.mean([with_claim for _, with_claim in risks]) < np.mean([alone for alone, _ in risks])


@pytest.mark.parametrize(
    "covariance",
    [np.zeros((3, 3)), np.eye(2), np.full((3, 3), np.nan), -np.eye(3)],
    ids=["singular", "two by two", "not finite", "negative"],
)
def test_covariance_of_claim_is_checked(covariance: np.ndarray) -> None:
    frame = drive(common=3, seed=2, frames=1)[0]
    with pytest.raises(ValueError, match="prior: the covariance must be"):
        BEVGlue().align(frame.ego, frame.other, prior=(frame.ego_SE2_other, covariance))
