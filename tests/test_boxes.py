"""Boxes: validated once, immutable, and moved between frames as one."""

from __future__ import annotations

import copy
import math
import pickle
from dataclasses import FrozenInstanceError
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cobevglue.boxes import Boxes
from cobevglue.se2 import SE2, wrap_angle

FIELDS = ("center", "size", "yaw", "score", "track_id", "label")
GOOD: dict[str, Any] = {
    "center": [[1, 2, 0], [3, 4, 0], [5, 6, 0]],
    "size": [[4.5, 2, 1.5], [5, 2, 0], [10, 2.5, 3]],
    "yaw": [0.0, 1.0, -2.0],
    "score": [0.9, 0.8, 0.7],
    "track_id": [7, 3, 12],
    "label": ["car", "van", "bus"],
}


def good(**changes: Any) -> Boxes:
    return Boxes(**{**GOOD, **changes})


def as_lists(boxes: Boxes) -> dict[str, Any]:
    return {name: None if (v := getattr(boxes, name)) is None else v.tolist() for name in FIELDS}


def row_changed(field: str, row: int, value: Any) -> dict[str, Any]:
    column = list(GOOD[field])
    column[row] = value
    return {field: column}


def test_fields_keep_their_values() -> None:
    assert as_lists(good()) == GOOD
    assert len(good()) == 3
    assert good().center.dtype == good().size.dtype == good().yaw.dtype == np.float64


@pytest.mark.parametrize("name", ["score", "track_id", "label"])
def test_scores_ids_and_labels_may_be_absent(name: str) -> None:
    assert getattr(good(**{name: None}), name) is None


@pytest.mark.parametrize(
    "kind", [list, tuple, np.asarray, lambda v: np.asarray(v, dtype=np.float32), lambda v: np.asarray(v)[::1]]
)
def test_any_array_like_is_taken(kind: Any) -> None:
    assert good(center=kind(GOOD["center"]), yaw=kind(GOOD["yaw"])).center.tolist() == GOOD["center"]


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        (row_changed("center", 1, [3, math.nan, 0]), "center: row 1 is not finite"),
        (row_changed("center", 2, [math.inf, 4, 0]), "center: row 2 is not finite"),
        (row_changed("size", 0, [4, 2, math.nan]), "size: row 0 is not finite"),
        (row_changed("yaw", 2, -math.inf), "yaw: row 2 is not finite"),
        (row_changed("score", 1, math.nan), "score: row 1 is not finite"),
        (row_changed("yaw", 1, None), "yaw: row 1 is not finite"),
        (row_changed("size", 1, [-4, 2, 1]), r"size: row 1 is \[-4.0, 2.0, 1.0\]; length and width must be > 0"),
        (row_changed("size", 2, [0, 2, 1]), "size: row 2"),
        (row_changed("size", 2, [4, 0, 1]), "size: row 2"),
        (row_changed("size", 2, [4, 2, -0.1]), "size: row 2"),
        (row_changed("track_id", 2, 7), "track_id: rows 0 and 2 have the same id 7"),
        (row_changed("track_id", 1, 1.5), "track_id: row 1 is not an integer: 1.5"),
        (row_changed("track_id", 0, math.nan), "track_id: row 0 is not finite"),
        (row_changed("track_id", 1, 1e30), "track_id: row 1 is 1.*ids must be below 2"),
        (row_changed("track_id", 1, 2**64), "track_id: row 1 is 18446744073709551616, ids must be below 2"),
        (row_changed("center", 1, [3, 4]), r"center: row 1 must be 3 numbers: \[3, 4\]"),
        (row_changed("center", 1, 3), "center: row 1 must be 3 numbers: 3"),
        (row_changed("center", 0, [3, "4", 0]), r"center: row 0 must be 3 numbers: \[3, '4', 0\]"),
        (row_changed("size", 2, ["a", 2, 1]), "size: row 2 must be 3 numbers"),
        (row_changed("yaw", 1, "north"), "yaw: row 1 must be a number: 'north'"),
        (row_changed("yaw", 1, "1.5"), "yaw: row 1 must be a number: '1.5'"),
        (row_changed("yaw", 1, 1j), "yaw: row 1 must be a number: 1j"),
        (row_changed("yaw", 1, [1.0]), r"yaw: row 1 must be a number: \[1.0\]"),
        (row_changed("track_id", 0, "7"), "track_id: row 0 must be a number: '7'"),
        ({"center": np.zeros((3, 2))}, r"center must have shape \(3, 3\), got \(3, 2\)"),
        ({"center": 5}, r"center must have shape \(N, 3\), got 5"),
        ({"size": np.ones((2, 3))}, r"size must have shape \(3, 3\), got \(2, 3\)"),
        ({"yaw": [0.0, 1.0]}, r"yaw must have shape \(3,\), got \(2,\)"),
        ({"yaw": 0.0}, r"yaw must have shape \(3,\), got \(\)"),
        ({"yaw": "up"}, r"yaw must be numbers of shape \(3,\)"),
        ({"score": [[0.1, 0.2, 0.3]]}, r"score must have shape \(3,\), got \(1, 3\)"),
        ({"track_id": [1, 2]}, r"track_id must have shape \(3,\), got \(2,\)"),
        ({"label": ["car"]}, r"label must have shape \(3,\), got \(1,\)"),
    ],
)
def test_bad_input_is_refused_by_field_and_row(changes: dict[str, Any], expected: str) -> None:
    with pytest.raises(ValueError, match=expected):
        good(**changes)


def test_an_unknown_height_is_fine() -> None:
    assert good(size=[[4, 2, 0]] * 3).size[0, 2] == 0


def test_large_track_ids_are_exact() -> None:
    ids = good(track_id=[2**53 + 1, 2**53, -(2**60) - 1]).track_id
    assert ids is not None
    assert ids.tolist() == [2**53 + 1, 2**53, -(2**60) - 1]
    assert ids.dtype == np.int64


def test_whole_floats_are_track_ids() -> None:
    assert as_lists(good(track_id=[1.0, 2.0, 3.0]))["track_id"] == [1, 2, 3]


def test_arguments_are_copied_and_fields_read_only() -> None:
    center = np.array(GOOD["center"], dtype=float)
    boxes = good(center=center)
    center[0, 0] = 99.0
    assert boxes.center[0, 0] == 1.0
    for name in FIELDS:
        with pytest.raises(ValueError, match="read-only"):
            getattr(boxes, name)[0] = getattr(boxes, name)[1]
    with pytest.raises(FrozenInstanceError):
        boxes.yaw = np.zeros(3)  # type: ignore[misc]


@pytest.mark.parametrize(
    "copied", [copy.copy, copy.deepcopy, lambda b: pickle.loads(pickle.dumps(b))], ids=["copy", "deepcopy", "pickle"]
)
def test_copy_is_equal_and_read_only(copied: Any) -> None:
    assert as_lists(copied(good())) == as_lists(good())
    assert not copied(good()).center.flags.writeable


@pytest.mark.parametrize("boxes", [Boxes.empty(), Boxes([], [], [], [], [], []), good()[[]], good()[:0]])
def test_no_boxes_is_a_valid_set(boxes: Boxes) -> None:
    assert len(boxes) == 0
    assert boxes.center.shape == boxes.size.shape == (0, 3)
    assert boxes.bev.shape == (0, 5)
    assert boxes.bev_corners().shape == (0, 4, 2)
    assert len(boxes.transform(SE2(1, 2, 3))) == 0


@pytest.mark.parametrize(
    ("rows", "expected", "why"),
    [
        ([2, 0], [5, 1], "integer rows, in their order"),
        (np.array([False, True, True]), [3, 5], "a mask"),
        ([True, False, True], [1, 5], "a mask as a list"),
        (slice(1, None), [3, 5], "a slice"),
        (1, [3], "one row is still Boxes"),
        (-1, [5], "counted from the end"),
        ([], [], "no rows"),
        (np.zeros(3, dtype=bool), [], "a mask that takes nothing"),
    ],
)
def test_rows_are_taken_from_every_field(rows: Any, expected: list[float], why: str) -> None:
    taken = good()[rows]
    assert taken.center[:, 0].tolist() == expected, why
    for name in FIELDS:
        assert len(getattr(taken, name)) == len(expected), why


def test_row_out_of_range_raises_index_error() -> None:
    with pytest.raises(IndexError):
        good()[3]


def test_repeated_row_with_ids_is_refused() -> None:
    with pytest.raises(ValueError, match="same id"):
        good()[[0, 0]]
    assert len(good(track_id=None)[[0, 0]]) == 2


def test_replace_changes_named_fields_and_validates() -> None:
    assert as_lists(good().replace(score=None, yaw=[1, 1, 1])) == {**GOOD, "score": None, "yaw": [1, 1, 1]}
    with pytest.raises(ValueError, match="yaw: row 0"):
        good().replace(yaw=[math.nan, 0, 0])
    with pytest.raises(TypeError):
        good().replace(heading=[0, 0, 0])


@pytest.mark.parametrize(
    ("parts", "expected"),
    [
        ([], []),
        ([Boxes.empty()], []),
        ([good()[:1], good()[1:]], [1, 3, 5]),
        ([good()[2], Boxes.empty(), good()[0]], [5, 1]),
    ],
)
def test_concatenate_keeps_order_and_common_fields(parts: list[Boxes], expected: list[float]) -> None:
    joined = Boxes.concatenate(parts)
    assert joined.center[:, 0].tolist() == expected
    assert (joined.label is None) == (not expected), "a part without boxes does not take the labels away"


def test_concatenate_drops_partial_fields_refuses_repeated_ids() -> None:
    assert Boxes.concatenate([good()[0], good(score=None)[1]]).score is None
    with pytest.raises(ValueError, match="track_id: rows 0 and 1 have the same id 7"):
        Boxes.concatenate([good()[0], good()[0]])


def test_selected_boxes_are_reversed() -> None:
    yaw = [0.1, -3.0, 7.0, math.pi]
    boxes = Boxes(np.zeros((4, 3)), np.ones((4, 3)), yaw, score=[0.1, 0.2, 0.3, 0.4])
    turned = boxes.flip_headings([True, True, False, False])
    assert turned.yaw.tolist() == pytest.approx([0.1 - math.pi, math.pi - 3.0, 7.0, math.pi], abs=1e-12)
    assert turned.yaw[2:].tolist() == yaw[2:]
    assert turned.score is not None
    assert turned.score.tolist() == [0.1, 0.2, 0.3, 0.4]


def test_transform_moves_centres_and_headings_and_nothing_else() -> None:
    moved = good().transform(SE2(10, 0, math.pi / 2))
    np.testing.assert_allclose(moved.center, [[8, 1, 0], [6, 3, 0], [4, 5, 0]], atol=1e-12)
    np.testing.assert_allclose(moved.yaw, np.array(GOOD["yaw"]) + math.pi / 2)
    unchanged = as_lists(moved)
    assert {k: unchanged[k] for k in FIELDS[3:] + ("size",)} == {k: GOOD[k] for k in FIELDS[3:] + ("size",)}


def test_bev_is_x_y_length_width_yaw() -> None:
    assert good().bev[0].tolist() == [1, 2, 4.5, 2, 0]


@pytest.mark.parametrize(
    ("yaw", "expected", "why"),
    [
        (0.0, [[3, 1], [-1, 1], [-1, -1], [3, -1]], "front left, rear left, rear right, front right"),
        (math.pi / 2, [[0, 2], [0, -2], [2, -2], [2, 2]], "facing left, the front left corner is up and to the left"),
        (math.pi, [[-1, -1], [3, -1], [3, 1], [-1, 1]], "facing backward"),
    ],
)
def test_corners_go_round_counter_clockwise_from_front_left(yaw: float, expected: Any, why: str) -> None:
    corners = Boxes([[1, 0, 0]], [[4, 2, 1]], [yaw]).bev_corners()[0]
    np.testing.assert_allclose(corners, expected, atol=1e-12, err_msg=why)


transforms = st.builds(SE2, st.floats(-1e3, 1e3), st.floats(-1e3, 1e3), st.floats(-10, 10))


@given(transforms, transforms)
def test_moving_twice_is_moving_by_the_product(a_SE2_b: SE2, b_SE2_c: SE2) -> None:
    once, twice = good().transform(a_SE2_b @ b_SE2_c), good().transform(b_SE2_c).transform(a_SE2_b)
    np.testing.assert_allclose(once.center, twice.center, atol=1e-8)
    np.testing.assert_allclose(wrap_angle(once.yaw - twice.yaw), 0.0, atol=1e-9)


@given(transforms)
def test_corners_commute_with_transform(dst_SE2_src: SE2) -> None:
    moved = good().transform(dst_SE2_src)
    np.testing.assert_allclose(moved.bev_corners(), dst_SE2_src.apply(good().bev_corners()), atol=1e-8)


@given(transforms)
def test_there_and_back_again(dst_SE2_src: SE2) -> None:
    back = good().transform(dst_SE2_src).transform(dst_SE2_src.inverse())
    np.testing.assert_allclose(back.center, good().center, atol=1e-8)
    np.testing.assert_allclose(wrap_angle(back.yaw - good().yaw), 0.0, atol=1e-9)
