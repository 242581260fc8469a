"""Objects within the other agent's view that it does not report count against a pose."""

from __future__ import annotations

import numpy as np
import pytest

from cobevglue import SE2, BEVGlue, BEVGlueConfig, Boxes
from cobevglue.alignment import absence, pose_search
from cobevglue.alignment.box_rows import box_rows

from .scenes import cars, random_boxes

pytestmark = pytest.mark.usefixtures("warm_kernels")


@pytest.mark.parametrize(
    ("ego", "other", "matched", "expected"),
    [
        pytest.param([(0, 0), (10, 0), (0, 10)], [(0, 0), (10, 0), (0, 10)], 3, 0, id="all matched"),
        pytest.param([(0, 0), (10, 0), (0, 10), (5, 5)], [(0, 0), (10, 0), (0, 10)], 3, 1, id="one amid the others"),
        pytest.param([(0, 0), (10, 0), (0, 10), (90, 0)], [(0, 0), (10, 0), (0, 10)], 3, 0, id="one far away"),
        pytest.param([(0, 0), (10, 0), (0, 10)], [(0, 0), (10, 0), (0, 10)], 0, 6, id="nothing matched, all in view"),
        pytest.param([(0, 0), (10, 0)], [(500, 0), (510, 0)], 0, 0, id="two agents far apart"),
    ],
)
def test_missing_counterparts_are_counted(
    ego: list[tuple[float, float]], other: list[tuple[float, float]], matched: int, expected: int
) -> None:
    star = np.zeros(1, pose_search.STAR)
    star[0]["pairs"] = matched
    pairs = np.column_stack([np.arange(max(matched, 1))] * 2)
    rows = box_rows(cars([(x, y, 0.0) for x, y in ego])), box_rows(cars([(x, y, 0.0) for x, y in other]))
    assert absence.missing_counterparts(*rows, star[0], pairs) == expected


def test_absence_raises_the_risk() -> None:
    """Four common objects: with ten more amid them that the other does not report, the pose is doubtful."""
    rng = np.random.default_rng(1)
    world = random_boxes(14, rng, reach=25.0)
    ego_SE2_other = SE2(4.0, -3.0, 0.7)
    other = world[:4].transform(ego_SE2_other.inverse())

    def risk(ego: Boxes, weight: float) -> float:
        glue = BEVGlue(BEVGlueConfig(absence=weight))
        return [glue.align(ego, other).risk for _ in range(10)][-1]

    assert risk(world[:4], 0.7) < 0.05
    assert risk(world, 0.0) < 0.05
    assert risk(world, 3.0) > 0.05
