"""Which anchor is to find which object, and boxes told relative to anchors."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from cobevglue.perception import AnchorGrid, assign_targets
from cobevglue.se2 import wrap_angle
from cobevglue.typing import FloatArray

from .conftest import SMALL

GRID = AnchorGrid(SMALL)
CAR = [0.4, 0.4, -1.0, 4.4, 2.0, 1.6, 0.0]
"""Exactly an anchor."""


def index_of(x: float, y: float, kind: int = 0) -> int:
    """The anchor of the cell at x, y."""
    return (int((y + 9.6) // 0.8) * GRID.columns + int((x + 12.8) // 0.8)) * GRID.types + kind


def rows(*boxes: list[float]) -> FloatArray:
    return np.array(boxes).reshape(-1, 7)


def nearest_iou(boxes: FloatArray) -> FloatArray:
    """(K, N) overlap of boxes with all anchors, headings rounded to 0 or 90 degrees, by shapely."""
    from shapely import area, box, intersection

    def rectangles(b: FloatArray) -> FloatArray:
        turned = np.abs(np.sin(b[:, 6])) > math.sqrt(0.5)
        half = np.where(turned[:, None], b[:, 4:2:-1], b[:, 3:5]) / 2
        shapes: FloatArray = box(*(b[:, :2] - half).T, *(b[:, :2] + half).T)
        return shapes

    a, b = rectangles(boxes)[:, None], rectangles(GRID.boxes(np.arange(len(GRID))))
    inter = area(intersection(a, b))
    iou: FloatArray = inter / (area(a) + area(b) - inter)
    return iou


def test_anchors_are_at_cell_centres() -> None:
    assert (GRID.rows, GRID.columns, GRID.types, GRID.cell) == (24, 32, 4, 0.8)
    assert len(GRID) == 24 * 32 * 4
    first, last = GRID.boxes([0, len(GRID) - 1])
    assert first == pytest.approx([-12.4, -9.2, -1.0, 4.4, 2.0, 1.6, 0.0])
    assert last == pytest.approx([12.4, 9.2, -0.2, 9.0, 2.6, 3.3, math.pi / 2])


BOXES = st.tuples(
    st.floats(-12, 12),
    st.floats(-9, 9),
    st.floats(-2, 1),
    st.floats(1, 15),
    st.floats(0.6, 3),
    st.floats(0.5, 4),
    st.floats(-3.14, 3.14),
)


@settings(max_examples=60, deadline=None)
@given(st.lists(BOXES, min_size=1, max_size=5), st.data())
def test_anchor_encoding_round_trips(boxes: list[tuple[float, ...]], data: st.DataObject) -> None:
    index = [data.draw(st.integers(0, len(GRID) - 1)) for _ in boxes]
    again = GRID.decode(*GRID.encode(np.array(boxes), index), index)
    assert np.allclose(again[:, :6], np.array(boxes)[:, :6], atol=1e-6)
    assert np.allclose(wrap_angle(again[:, 6] - np.array(boxes)[:, 6]), 0, atol=1e-6)


@settings(max_examples=20, deadline=None)
@given(st.lists(BOXES, min_size=1, max_size=6))
def test_assignment_equals_that_over_all_pairs(boxes: list[tuple[float, ...]]) -> None:
    array = np.array(boxes)
    iou = nearest_iou(array)
    targets = assign_targets(array, np.zeros(len(array), dtype=bool), GRID)
    owned = GRID.decode(targets.residuals, targets.direction, targets.positive)
    best = iou.max(axis=0)
    clear = np.abs(best[:, None] - [SMALL.positive_iou, SMALL.negative_iou]).min(axis=1) > 1e-9
    assert set(np.flatnonzero(clear & (best >= SMALL.positive_iou))) <= set(targets.positive)
    between = clear & (best >= SMALL.negative_iou) & (best < SMALL.positive_iou)
    assert set(np.flatnonzero(between)) <= set(targets.positive) | set(targets.ignored)
    assert not set(targets.positive) & set(targets.ignored)
    assert not (best[targets.ignored] < SMALL.negative_iou - 1e-9).any()
    distance = np.abs(owned[:, None, :6] - array[None, :, :6]).max(axis=2)
    distance = np.maximum(distance, np.abs(np.sin(owned[:, None, 6] - array[None, :, 6])))
    assert (distance.min(axis=1) < 1e-4).all(), "every positive is one of the objects"
    own = iou[distance.argmin(axis=1), targets.positive]
    by_rule = best[targets.positive] >= SMALL.positive_iou
    assert np.allclose(own[by_rule], best[targets.positive][by_rule]), "the one it overlaps most"


@pytest.mark.parametrize(
    ("box", "why"),
    [
        (CAR, "a car"),
        ([0.1, 0.1, -1, 2.2, 0.8, 1.4, 1.0], "a motorcycle, which overlaps no anchor by half"),
        ([3.0, 3.0, 0, 18.0, 2.6, 3.8, 0.8], "an articulated lorry"),
        ([12.79, 9.59, -1, 4.4, 2.0, 1.6, 0.7], "in the last cell"),
        ([-12.8, -9.6, -1, 4.4, 2.0, 1.6, 0.7], "in the first"),
        ([0, 0, -1, 0.3, 0.3, 1.7, 0.7], "smaller than a cell"),
    ],
)
def test_every_object_has_an_anchor(box: list[float], why: str) -> None:
    targets = assign_targets(rows(box), [False], GRID)
    assert len(targets.positive) >= 1, why
    decoded = GRID.decode(targets.residuals, targets.direction, targets.positive)
    assert np.allclose(decoded[:, :6], np.array(box)[:6], atol=1e-5)


def test_small_object_takes_nearest_anchor() -> None:
    """Of a dozen that cover it alike."""
    targets = assign_targets(rows([0.5, 0.3, -1, 1.0, 0.6, 1.4, 0.0]), [False], GRID)
    assert targets.positive.tolist() == [index_of(0.4, 0.4)]


def test_coincident_objects_get_one_anchor_each() -> None:
    small = [0.4, 0.4, -1, 1.0, 0.6, 1.4, 0.0]
    targets = assign_targets(rows(small, small), [False, False], GRID)
    assert len(targets.positive) == 2


@pytest.mark.parametrize(
    ("yaw", "kind", "direction", "residual"),
    [
        (0.1, 0, 0, 0.1),
        (-0.1, 0, 0, -0.1),
        (math.pi - 0.1, 0, 1, -0.1),
        (-math.pi + 0.1, 0, 1, 0.1),
        (math.pi / 2 + 0.1, 1, 0, 0.1),
        (-math.pi / 2 + 0.1, 1, 1, 0.1),
    ],
)
def test_direction_target_is_relative_to_anchor(yaw: float, kind: int, direction: int, residual: float) -> None:
    targets = assign_targets(rows([*CAR[:6], yaw]), [False], GRID)
    row = targets.positive.tolist().index(index_of(0.4, 0.4, kind))
    assert targets.direction[row] == direction
    assert targets.residuals[row, 6] == pytest.approx(residual)


def test_ignored_objects_are_neither_target_nor_background() -> None:
    asked = assign_targets(rows(CAR), [False], GRID)
    ignored = assign_targets(rows(CAR), [True], GRID)
    assert len(ignored.positive) == 0
    assert set(asked.positive) | set(asked.ignored) < set(ignored.ignored)


def test_ignored_object_takes_no_anchor_from_others() -> None:
    alone = assign_targets(rows(CAR), [False], GRID)
    both = assign_targets(rows(CAR, CAR), [False, True], GRID)
    assert both.positive.tolist() == alone.positive.tolist()


@pytest.mark.parametrize("x", [13.0, 14.0, 25.0, 1e12])
def test_objects_outside_are_no_targets(x: float) -> None:
    targets = assign_targets(rows([x, *CAR[1:]]), [False], GRID)
    assert len(targets.positive) == 0
    assert (len(targets.ignored) > 0) == (x < 20), "what reaches in is not background either"


def test_no_objects_no_targets() -> None:
    targets = assign_targets(np.zeros((0, 7)), np.zeros(0, dtype=bool), GRID)
    assert len(targets.positive) == len(targets.ignored) == 0
    assert targets.residuals.shape == (0, 7)


@pytest.mark.parametrize(
    ("boxes", "ignore", "message"),
    [
        (rows(CAR), [False, True], "shapes"),
        (np.zeros((2, 6)), [False, False], "shapes"),
        (rows(CAR, [math.nan, *CAR[1:]]), [False, False], "row 1"),
        (rows([*CAR[:5], 0.0, 0.0]), [False], "row 0 is not finite or has no size"),
    ],
)
def test_bad_input_is_named(boxes: FloatArray, ignore: list[bool], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        assign_targets(boxes, ignore, GRID)
