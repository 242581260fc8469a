from __future__ import annotations

import subprocess
import sys
from collections.abc import Sequence

import numpy as np
import pytest
import shapely
from hypothesis import given, settings
from hypothesis import strategies as st

from cobevglue import SE2, Boxes
from cobevglue.iou import bev_giou, bev_iou, nms
from cobevglue.typing import FloatArray


def make(rows: Sequence[tuple[float, float, float, float, float]], score: list[float] | None = None) -> Boxes:
    """Boxes from x, y, length, width, yaw in degrees."""
    table = np.array(rows, dtype=float).reshape(-1, 5)
    n = len(table)
    return Boxes(
        np.column_stack([table[:, :2], np.zeros(n)]),
        np.column_stack([table[:, 2:4], np.ones(n)]),
        np.radians(table[:, 4]),
        score=score,
    )


TABLE = {
    "a box covers itself": ((1, 2, 4, 2, 30), (1, 2, 4, 2, 30), 1.0),
    "turned by half a turn it is the same rectangle": ((1, 2, 4, 2, 30), (1, 2, 4, 2, 210), 1.0),
    "shifted by half its length: a third": ((0, 0, 4, 2, 0), (2, 0, 4, 2, 0), 1 / 3),
    "boxes that share an edge only touch": ((0, 0, 4, 2, 0), (4, 0, 4, 2, 0), 0.0),
    "a small box inside a large one: the ratio of areas": ((0, 0, 10, 10, 0), (1, 1, 2, 1, 33), 0.02),
    "a cross of two bars 4 x 2: 4 of 12": ((0, 0, 4, 2, 0), (0, 0, 4, 2, 90), 1 / 3),
    "two unit squares at 45 degrees: an octagon": ((0, 0, 1, 1, 0), (0, 0, 1, 1, 45), 2**-0.5),
    "only a corner of 0.5 x 0.1 in common": ((0, 0, 4, 2, 0), (3.5, 1.9, 4, 2, 0), 0.05 / 15.95),
    "the circles around them overlap, they do not": ((0, 0, 4, 2, 0), (3.5, 2.1, 4, 2, 0), 0.0),
    "far apart": ((0, 0, 4, 2, 0), (100, 0, 4, 2, 0), 0.0),
}


@pytest.mark.parametrize(("a", "b", "expected"), TABLE.values(), ids=TABLE.keys())
def test_iou_of_two_boxes(a: tuple[float, ...], b: tuple[float, ...], expected: float) -> None:
    assert bev_iou(make([a]), make([b])) == pytest.approx(expected, abs=1e-12)  # type: ignore[list-item]


def shapely_iou(a: Boxes, b: Boxes) -> FloatArray:
    pa, pb = shapely.polygons(a.bev_corners())[:, None], shapely.polygons(b.bev_corners())[None]
    overlap: FloatArray = shapely.area(shapely.intersection(pa, pb))
    iou: FloatArray = overlap / (shapely.area(pa) + shapely.area(pb) - overlap)
    return iou


def shapely_giou(a: Boxes, b: Boxes) -> FloatArray:
    pa, pb = shapely.polygons(a.bev_corners())[:, None], shapely.polygons(b.bev_corners())[None]
    union = shapely.area(shapely.union(pa, pb))
    hull = shapely.area(shapely.convex_hull(shapely.union(pa, pb)))
    giou: FloatArray = shapely_iou(a, b) - (hull - union) / hull
    return giou


box = st.tuples(st.floats(-6, 6), st.floats(-6, 6), st.floats(0.2, 12), st.floats(0.2, 4), st.floats(-720, 720))
# Whole numbers and right angles meet on edges and corners, where clipping goes wrong if it does.
gridded = st.tuples(
    st.integers(-4, 4), st.integers(-4, 4), st.integers(1, 6), st.integers(1, 6), st.sampled_from([0, 45, 90, 180, 270])
)
some_boxes = st.lists(box | gridded, max_size=6).map(make)


@given(some_boxes, some_boxes)
@settings(deadline=None)
def test_agrees_with_shapely(a: Boxes, b: Boxes) -> None:
    iou = bev_iou(a, b)
    assert iou.shape == (len(a), len(b))
    assert ((iou >= 0) & (iou <= 1)).all()
    if iou.size:
        np.testing.assert_allclose(iou, shapely_iou(a, b), atol=1e-9)
        np.testing.assert_allclose(bev_giou(a, b), shapely_giou(a, b), atol=1e-9)
    np.testing.assert_allclose(iou, bev_iou(b, a).T, atol=1e-12)


@given(some_boxes, some_boxes, st.floats(-1e4, 1e4), st.floats(-1e4, 1e4), st.floats(-4, 4))
@settings(deadline=None)
def test_moving_both_changes_nothing(a: Boxes, b: Boxes, x: float, y: float, yaw: float) -> None:
    moved = SE2(x, y, yaw)
    np.testing.assert_allclose(bev_iou(a.transform(moved), b.transform(moved)), bev_iou(a, b), atol=1e-8)


def test_giou_falls_with_distance_until_the_gate() -> None:
    giou = bev_giou(make([(0, 0, 4, 2, 0)]), make([(x, 0, 4, 2, 0) for x in (0, 3, 6, 12)]), max_distance=10)[0]
    np.testing.assert_allclose(giou, [1.0, 1 / 7, -0.2, -1.0])  # at 6 m the hull is 10 long, 8 of it covered
    with pytest.raises(ValueError, match="max_distance"):
        bev_giou(Boxes.empty(), Boxes.empty(), max_distance=-1)


def test_nms_keeps_best_of_each_cluster() -> None:
    cars = make([(0, 0, 4, 2, 0), (0.5, 0, 4, 2, 0), (20, 0, 4, 2, 90), (20, 0.2, 4, 2, -90), (40, 0, 4, 2, 0)],
                score=[0.5, 0.9, 0.3, 0.2, 0.6])  # fmt: skip
    assert nms(cars, 0.1).tolist() == [1, 4, 2]
    assert nms(cars, 1.0).tolist() == [1, 4, 0, 2, 3]


def test_nms_is_greedy_a_dropped_box_drops_nothing() -> None:
    chain = make([(0, 0, 4, 2, 0), (2, 0, 4, 2, 0), (4, 0, 4, 2, 0)], score=[0.9, 0.8, 0.7])
    assert nms(chain, 0.3).tolist() == [0, 2]


def test_nms_equal_scores_go_by_row() -> None:
    assert nms(make([(0, 0, 4, 2, 0)] * 3 + [(9, 0, 4, 2, 0)], score=[1, 1, 1, 1]), 0.5).tolist() == [0, 3]


def test_nms_of_nothing() -> None:
    assert nms(Boxes.empty().replace(score=[]), 0.5).tolist() == []


@given(st.lists(box, max_size=12), st.data())
@settings(deadline=None)
def test_nms_agrees_with_its_definition(
    rows: list[tuple[float, float, float, float, float]], data: st.DataObject
) -> None:
    score = data.draw(st.lists(st.sampled_from([0.1, 0.5, 0.9]), min_size=len(rows), max_size=len(rows)))
    boxes = make(rows, score)
    overlap, expected = bev_iou(boxes, boxes), list[int]()
    for row in sorted(range(len(rows)), key=lambda r: -score[r]):
        if all(overlap[row, k] <= 0.2 + 1e-9 for k in expected):
            expected.append(row)
    close = np.abs(overlap - 0.2) < 1e-8
    if not close.any():
        assert nms(boxes, 0.2).tolist() == expected


@pytest.mark.parametrize(
    ("boxes", "threshold", "match"),
    [
        (Boxes.empty(), 0.5, "score"),
        (make([(0, 0, 4, 2, 0)], [1.0]), 1.5, "iou_threshold"),
        (make([(0, 0, 4, 2, 0)], [1.0]), float("nan"), "iou_threshold"),
    ],
)
def test_bad_input_is_named(boxes: Boxes, threshold: float, match: str) -> None:
    with pytest.raises(ValueError, match=match):
        nms(boxes, threshold)


def test_importing_does_not_import_numba() -> None:
    code = "import sys, cobevglue.iou; print('numba' in sys.modules, 'torch' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.split() == ["False", "False"]
