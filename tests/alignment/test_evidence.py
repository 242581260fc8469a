"""The evidence of pairs of boxes: log-likelihood ratios."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.stats import multivariate_normal

from cobevglue.alignment.evidence import NoiseModel, pair_evidence, size_evidence, wrap, wrap_half_turn
from cobevglue.se2 import wrap_angle
from cobevglue.typing import FloatArray

NOISE = NoiseModel(
    position_std=0.5,
    heading_std=0.1,
    length_std=1.0,
    width_std=0.2,
    size_gain=0.7,
    density=0.01,
    flip_probability=0.1,
    use_size=True,
    use_flips=True,
    use_range_tolerance=True,
    one_to_one=True,
)


def footprints(*length_and_width: tuple[float, float]) -> FloatArray:
    rows = np.zeros((len(length_and_width), 5))
    rows[:, 2:4] = length_and_width
    return rows


@pytest.mark.parametrize("angle", [0.0, 1.0, math.pi, -math.pi, 3.2, -7.0, 100.0])
def test_angle_differences_wrap_at_full_and_half_turn(angle: float) -> None:
    assert wrap(angle) == pytest.approx(float(wrap_angle(angle)))
    half = wrap_half_turn(angle)
    assert -math.pi / 2 <= half < math.pi / 2
    assert math.sin(2.0 * (half - angle)) == pytest.approx(0.0, abs=1e-12)
    assert math.cos(2.0 * (half - angle)) == pytest.approx(1.0), "the same axis"


def test_size_evidence_falls_with_size_difference() -> None:
    table = size_evidence(footprints((4.5, 1.9)), footprints((4.5, 1.9), (5.0, 1.9), (7.0, 1.9), (7.0, 2.5)), NOISE)[0]
    assert table[0] == pytest.approx(NOISE.size_gain)
    assert list(table) == sorted(table, reverse=True)
    assert len(set(table)) == 4
    assert table[3] < 0.0 < table[0]


def test_size_evidence_does_not_depend_on_the_roles() -> None:
    a, b = footprints((4.5, 1.9), (8.0, 2.5), (4.0, 1.7)), footprints((4.4, 2.0), (12.0, 2.5))
    np.testing.assert_allclose(size_evidence(a, b, NOISE), size_evidence(b, a, NOISE).T)


def test_sizes_can_be_left_out() -> None:
    table = size_evidence(footprints((4.5, 1.9)), footprints((4.5, 1.9), (12.0, 2.5)), NOISE._replace(use_size=False))
    assert table.tolist() == [[0.0, 0.0]]


@pytest.mark.parametrize("gap", [0.0, 0.4, 1.5, 4.0])
@pytest.mark.parametrize("variance", [0.25, 1.0])
def test_position_evidence_is_gaussian_over_uniform_density(gap: float, variance: float) -> None:
    """What a distance adds, as scipy has it: log N(gap) - log density; the heading's share is the same for all."""
    density = multivariate_normal([0.0, 0.0], variance * np.eye(2)).logpdf([gap, 0.0]) - math.log(NOISE.density)
    nearest = multivariate_normal([0.0, 0.0], np.eye(2)).logpdf([0.0, 0.0]) - math.log(NOISE.density)
    found = pair_evidence(gap**2, 0.0, variance, NOISE) - pair_evidence(0.0, 0.0, 1.0, NOISE)
    assert found == pytest.approx(density - nearest)


def test_heading_evidence_falls_to_a_right_angle() -> None:
    evidence = [pair_evidence(0.0, math.radians(h), 0.25, NOISE) for h in (0, 2, 5, 10, 20)]
    assert evidence == sorted(evidence, reverse=True)
    assert len(set(evidence)) == 5
    assert pair_evidence(0.0, -0.1, 0.25, NOISE) == pytest.approx(pair_evidence(0.0, 0.1, 0.25, NOISE))


@pytest.mark.parametrize("heading", [0.0, 0.1, -0.3])
def test_a_turned_heading_costs_its_log_odds(heading: float) -> None:
    straight = pair_evidence(0.1, heading, 0.25, NOISE)
    turned = pair_evidence(0.1, heading + math.pi, 0.25, NOISE)
    assert straight - turned == pytest.approx(math.log(0.9 / 0.1))


def test_without_flips_reversed_heading_rules_pair_out() -> None:
    plain = NOISE._replace(use_flips=False)
    assert pair_evidence(0.0, math.pi, 0.25, plain) < -10.0
    assert pair_evidence(0.0, 0.0, 0.25, plain) > pair_evidence(0.0, 0.0, 0.25, NOISE)


def test_lower_density_gives_pairs_more_evidence() -> None:
    """Where boxes are twice as dense, a pair that lies together counts log 2 less."""
    dense = NOISE._replace(density=2.0 * NOISE.density)
    assert pair_evidence(0.2, 0.1, 0.3, NOISE) - pair_evidence(0.2, 0.1, 0.3, dense) == pytest.approx(math.log(2.0))
