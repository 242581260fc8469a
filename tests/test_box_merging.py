"""Merging of boxes of the same objects from several sources."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cobevglue import SE2, Boxes
from cobevglue.box_merging import merge_boxes


def cars(*rows: tuple[float, float, float, float]) -> Boxes:
    """Cars at x, y [m] with yaw [degrees] and score."""
    x, y, yaw, score = np.array(rows, dtype=float).reshape(-1, 4).T
    n = len(x)
    return Boxes(np.column_stack([x, y, np.zeros(n)]), np.tile([4.0, 2.0, 1.6], (n, 1)), np.radians(yaw), score)


@pytest.mark.parametrize(
    ("sources", "expected"),
    [
        pytest.param([cars((0, 0, 0, 0.8))], [(0, 0, 0, 0.72)], id="one source: its score by its reliability"),
        pytest.param(
            [cars((0, 0, 0, 0.8)), cars((0.4, 0, 0, 0.8))],
            [(0.2, 0, 0, 0.9216)],
            id="two agree: the mean, a higher score",
        ),
        pytest.param(
            [cars((0, 0, 0, 0.8)), cars((0.5, 0, 0, 0.4))],
            [(0.1, 0, 0, 0.8208)],
            id="weights are squared scores, 4 to 1",
        ),
        pytest.param(
            [cars((0, 0, 0, 0.8)), cars((0, 0, 180, 0.4))], [(0, 0, 0, 0.8208)], id="the direction of the larger weight"
        ),
        pytest.param(
            [cars((0, 0, 178, 0.5)), cars((0, 0, -178, 0.5))], [(0, 0, 180, 0.6975)], id="headings beside 180 degrees"
        ),
        pytest.param(
            [cars((0, 0, 0, 0.8)), cars((9, 0, 0, 0.9))], [(9, 0, 0, 0.81), (0, 0, 0, 0.72)], id="apart: two objects"
        ),
        pytest.param(
            [cars((0, 0, 0, 0.8), (0.2, 0, 0, 0.5)), cars((0.4, 0, 0, 0.8))],
            [(0.2, 0, 0, 0.9216)],
            id="of one source only one box is of an object",
        ),
        pytest.param([cars(), cars()], [], id="nothing"),
    ],
)
def test_merged_boxes(sources: list[Boxes], expected: list[tuple[float, float, float, float]]) -> None:
    merged = merge_boxes(sources)
    assert len(merged) == len(expected)
    for row, (x, y, yaw, score) in enumerate(expected):
        np.testing.assert_allclose(merged.center[row, :2], [x, y], atol=1e-9)
        assert math.cos(merged.yaw[row] - math.radians(yaw)) == pytest.approx(1.0)
        assert merged.score is not None
        assert merged.score[row] == pytest.approx(score)


_CARS = st.lists(
    st.tuples(st.integers(-30, 30), st.integers(-30, 30), st.integers(-179, 180), st.floats(0.05, 0.95)),
    max_size=6,
    unique_by=lambda row: row[3],
).map(lambda rows: cars(*rows))


@given(st.lists(_CARS, min_size=1, max_size=4), st.floats(-20, 20), st.floats(-3, 3))
def test_merging_commutes_with_a_rigid_motion(sources: list[Boxes], x: float, yaw: float) -> None:
    pose = SE2(x, -x, yaw)
    before = merge_boxes(sources).transform(pose)
    after = merge_boxes([one.transform(pose) for one in sources])
    assert len(before) == len(after)
    np.testing.assert_allclose(before.center, after.center, atol=1e-6)


@given(st.lists(_CARS, min_size=2, max_size=4))
def test_merged_objects_never_outnumber_boxes(sources: list[Boxes]) -> None:
    merged = merge_boxes(sources)
    assert len(merged) <= sum(map(len, sources))
    assert len(merged) >= (1 if any(map(len, sources)) else 0)


@pytest.mark.parametrize(
    ("sources", "reliability", "message"),
    [
        ([cars((0, 0, 0, 0.5)), cars((0, 0, 0, 0.5)).replace(score=None)], None, "source 1 have no score"),
        ([cars((0, 0, 0, 0.5))], [0.5, 0.5], "reliability must be 1 numbers"),
        ([cars((0, 0, 0, 0.5))], [1.0], r"reliability must be 1 numbers in \[0, 1\)"),
    ],
)
def test_bad_sources_are_named(sources: list[Boxes], reliability: list[float] | None, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        merge_boxes(sources, reliability)
