"""Fused boxes face as the agents that see the vehicles say."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cobevglue.boxes import Boxes
from cobevglue.fusion.heading import vote_headings


def cars(*rows: tuple[float, float, float], score: float | None = None) -> Boxes:
    """Cars at x, y [m] with a heading [degrees]."""
    n = len(rows)
    array = np.array(rows, dtype=np.float64).reshape(-1, 3)
    center = np.column_stack([array[:, :2], np.zeros(n)])
    scores = None if score is None else np.full(n, score)
    return Boxes(center, np.tile([4.5, 1.9, 1.6], (n, 1)), np.radians(array[:, 2]), scores)


@pytest.mark.parametrize(
    ("told", "turned"),
    [
        ([], False),  # nobody says anything
        ([cars((0, 0, 5))], False),  # the one agent agrees
        ([cars((0, 0, 175))], True),  # it does not
        ([cars((0.3, 0.2, -170))], True),  # nor here, where its box is a little off
        ([cars((9, 0, 180))], False),  # that is another car
        ([cars((0, 4, 180), (0, 0, 0))], False),  # and so is that in the lane beside
        ([cars((0, 0, 180), score=0.9), cars((0, 0, 0), score=0.5)], True),  # the surer of two wins
        ([cars((0, 0, 180), score=0.5), cars((0, 0, 0), score=0.9)], False),
        ([cars((1.5, 0, 180)), cars((0, 0, 0))], False),  # the one that overlaps more
        ([cars((0, 0, 180)), cars((0, 0, 180)), cars((0, 0, 0))], True),  # two against one
        ([cars()], False),
    ],
)
def test_majority_decides_the_heading(told: list[Boxes], turned: bool) -> None:
    boxes = cars((0, 0, 0), score=0.7)
    faced = vote_headings(boxes, told)
    assert bool(np.cos(faced.yaw[0]) < 0) == turned
    np.testing.assert_array_equal(faced.center, boxes.center)
    np.testing.assert_array_equal(faced.size, boxes.size)
    assert faced.score is not None
    assert faced.score.tolist() == [0.7]


@given(st.lists(st.tuples(st.floats(-9, 9), st.floats(-9, 9), st.floats(-180, 179)), max_size=4), st.integers(0, 3))
def test_boxes_are_only_reversed_and_idempotent(rows: list[tuple[float, float, float]], agents: int) -> None:
    boxes = cars(*rows)
    told = [cars((1.0, agent, 90.0 * agent), (-4.0, agent, 45.0)) for agent in range(agents)]
    once = vote_headings(boxes, told)
    np.testing.assert_allclose(np.abs(np.sin(once.yaw - boxes.yaw)), 0.0, atol=1e-9)
    np.testing.assert_allclose(vote_headings(once, told).yaw, once.yaw)
