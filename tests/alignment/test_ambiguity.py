"""Single frames with regular patterns of equal cars: refused, whether or not both agents see the same part."""

from __future__ import annotations

import pytest

from cobevglue import SE2, BEVGlue, Boxes

EGO_SE2_OTHER = SE2(10.0, -5.0, 1.0)


def grid(columns: int, rows: int, gap_x: float, gap_y: float, yaw: float) -> Boxes:
    """Equal cars at the crossings of a grid, column by column."""
    centers = [(gap_x * i, gap_y * j, 0.0) for i in range(columns) for j in range(rows)]
    return Boxes(centers, [(4.5, 1.9, 1.6)] * len(centers), [yaw] * len(centers))


@pytest.mark.parametrize("hidden", [0, 1])  # columns that only one of the two sees at either end
@pytest.mark.parametrize(
    ("columns", "rows", "gap_x", "gap_y", "yaw"),
    [
        (3, 1, 2.6, 0.0, 1.57),  # three cars side by side
        (8, 1, 2.6, 0.0, 1.57),  # a parked row, side by side
        (8, 1, 6.0, 0.0, 0.0),  # a queue in one lane
        (3, 3, 6.0, 9.0, 0.0),  # grids: a shift by a column loses one pair in so many columns
        (4, 4, 6.0, 9.0, 0.0),
        (6, 6, 6.0, 9.0, 0.0),
    ],
)
def test_a_regular_pattern_is_refused(
    columns: int, rows: int, gap_x: float, gap_y: float, yaw: float, hidden: int
) -> None:
    world = grid(columns + hidden, rows, gap_x, gap_y, yaw)
    ego = world[: columns * rows]
    other = world[hidden * rows :].transform(EGO_SE2_OTHER.inverse())
    alignment = BEVGlue().align(ego, other)
    assert not alignment.accepted
    assert alignment.reason
