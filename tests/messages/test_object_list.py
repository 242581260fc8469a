"""Object lists: what is written is read back exactly, and each bad input is one line that says what and where."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from cobevglue.boxes import Boxes
from cobevglue.messages import from_dict, read_object_list, to_dict, write_object_list

ROW = {"x": 1.0, "y": 2.0, "z": -1.0, "l": 4.5, "w": 1.9, "h": 1.5, "yaw": 0.1}
FULL = {**ROW, "score": 0.9, "track_id": 7, "label": "car"}


def without(*keys: str, row: dict[str, Any] = FULL) -> dict[str, Any]:
    return {key: value for key, value in row.items() if key not in keys}


numbers = st.floats(-1e9, 1e9)
sides = st.floats(1e-3, 1e3)


@st.composite
def any_boxes(draw: st.DrawFn) -> Boxes:
    n = draw(st.integers(1, 5))

    def column(values: st.SearchStrategy[Any], unique: bool = False) -> Any:
        return draw(st.lists(values, min_size=n, max_size=n, unique=unique))

    return Boxes(
        center=column(st.tuples(numbers, numbers, numbers)),
        size=column(st.tuples(sides, sides, sides)),
        yaw=column(numbers),
        score=None if draw(st.booleans()) else column(st.floats(0, 1)),
        track_id=None if draw(st.booleans()) else column(st.integers(-(2**53), 2**53), unique=True),
        label=None if draw(st.booleans()) else column(st.text(st.characters(exclude_characters="\0"), max_size=5)),
    )


@given(any_boxes())
def test_a_list_through_json_is_the_same_list(boxes: Boxes) -> None:
    again = from_dict(json.loads(json.dumps(to_dict(boxes))))
    for name in ("center", "size", "yaw", "score", "track_id", "label"):
        was, now = getattr(boxes, name), getattr(again, name)
        assert (was is None) == (now is None), name
        if was is not None:
            np.testing.assert_array_equal(now, was)


def test_a_file_comes_back_exactly(tmp_path: Path) -> None:
    boxes = Boxes([[0.1, 1 / 3, -1]], [[4.5, 1.9, 0]], [math.pi], score=[0.7], track_id=[3], label=["café"])
    write_object_list(tmp_path / "a.json", boxes)
    again = read_object_list(tmp_path / "a.json")
    assert to_dict(again) == to_dict(boxes)
    assert len((tmp_path / "a.json").read_text(encoding="utf-8").splitlines()) == 3, "one row a line"


def test_an_empty_list_is_no_boxes(tmp_path: Path) -> None:
    write_object_list(tmp_path / "a.json", Boxes.empty())
    assert len(read_object_list(tmp_path / "a.json")) == 0


@pytest.mark.parametrize(
    ("row", "field", "expected", "why"),
    [
        (FULL, "center", [[1.0, 2.0, -1.0]], "x, y, z are the centre"),
        (FULL, "size", [[4.5, 1.9, 1.5]], "l, w, h are the size"),
        (FULL, "yaw", [0.1], "yaw is in radians"),
        (FULL, "score", [0.9], "score is kept"),
        (FULL, "track_id", [7], "track_id is kept"),
        (FULL, "label", ["car"], "label is kept"),
        (without("z"), "center", [[1.0, 2.0, 0.0]], "z is 0 when left out"),
        (without("h"), "size", [[4.5, 1.9, 0.0]], "h is 0 when left out"),
        (without("score"), "score", None, "score may be left out"),
        (without("track_id"), "track_id", None, "track_id may be left out"),
        (without("label"), "label", None, "label may be left out"),
        ({**FULL, "score": None, "z": None}, "score", None, "null counts as left out"),
        ({**FULL, "x": 3}, "center", [[3.0, 2.0, -1.0]], "a whole number is a number"),
        ({**FULL, "track_id": 7.0}, "track_id", [7], "other programs may write 7 as 7.0"),
        ({**FULL, "track_id": 2**53 + 1}, "track_id", [2**53 + 1], "large ids are exact"),
    ],
)
def test_what_a_row_means(row: dict[str, Any], field: str, expected: Any, why: str) -> None:
    value = getattr(from_dict({"boxes": [row]}), field)
    assert (value if value is None else value.tolist()) == expected, why


@pytest.mark.parametrize(
    ("document", "expected"),
    [
        ([], 'must be a JSON object {"boxes": [...]}, got a list'),
        ("boxes", "got a string"),
        (None, "got null"),
        (3, "got a int"),
        ({}, 'the key "boxes" is missing'),
        ({"boxs": []}, "unknown key 'boxs', the nearest valid key is \"boxes\""),
        ({"boxes": [], "frame": 1}, "unknown key 'frame'"),
        ({"boxes": {}}, "boxes must be a list, got an object"),
        ({"boxes": None}, "boxes must be a list, got null"),
        ({"boxes": [ROW, [1, 2]]}, "boxes: row 1 must be an object"),
        ({"boxes": [ROW, without("yaw", row=ROW)]}, 'boxes: row 1: the key "yaw" is missing'),
        ({"boxes": [{**ROW, "x": None}]}, 'boxes: row 0: the key "x" is missing'),
        ({"boxes": [ROW, {**ROW, "y": "2.0"}]}, "boxes: row 1: y must be a number, got '2.0'"),
        ({"boxes": [{**ROW, "l": True}]}, "boxes: row 0: l must be a number, got True"),
        ({"boxes": [{**ROW, "x": [1]}]}, "boxes: row 0: x must be a number, got [1]"),
        ({"boxes": [ROW, {**ROW, "z": math.nan}]}, "boxes: row 1: z must be a finite number, got nan"),
        ({"boxes": [{**ROW, "yaw": math.inf}]}, "boxes: row 0: yaw must be a finite number, got inf"),
        ({"boxes": [{**ROW, "x": 10**400}]}, "boxes: row 0: x must be a finite number"),
        ({"boxes": [ROW, {**ROW, "w": -1.9}]}, "size: row 1 is [4.5, -1.9, 1.5]"),
        ({"boxes": [{**ROW, "l": 0}]}, "size: row 0"),
        ({"boxes": [{**ROW, "h": -0.1}]}, "size: row 0"),
        ({"boxes": [FULL, FULL]}, "track_id: rows 0 and 1 have the same id 7"),
        ({"boxes": [{**ROW, "track_id": 1.5}]}, "boxes: row 0: track_id must be a whole number"),
        ({"boxes": [{**ROW, "track_id": math.nan}]}, "boxes: row 0: track_id must be a whole number"),
        ({"boxes": [{**ROW, "track_id": math.inf}]}, "boxes: row 0: track_id must be a whole number"),
        ({"boxes": [{**ROW, "track_id": 2**63}]}, "boxes: row 0: track_id must be a whole number"),
        ({"boxes": [{**ROW, "track_id": "7"}]}, "boxes: row 0: track_id must be a number, got '7'"),
        ({"boxes": [{**ROW, "score": "high"}]}, "boxes: row 0: score must be a number, got 'high'"),
        ({"boxes": [{**ROW, "label": 3}]}, "boxes: row 0: label must be a string, got 3"),
        (
            {"boxes": [FULL, without("score", row={**FULL, "track_id": 8})]},
            "boxes: row 1: score is missing, but row 0 has",
        ),
        ({"boxes": [ROW, {**ROW, "track_id": 1}]}, "boxes: row 0: track_id is missing, but row 1 has"),
        ({"boxes": [ROW, {**ROW, "label": "a"}]}, "boxes: row 0: label is missing, but row 1 has"),
        ({"boxes": [{**ROW, "Yaw": 1}]}, "boxes: row 0: unknown key 'Yaw', the nearest valid key is \"yaw\""),
        ({"boxes": [{**ROW, "trackid": 1}]}, 'the nearest valid key is "track_id"'),
        ({"boxes": [{**ROW, "length": 1}]}, 'the nearest valid key is "l"'),
        ({"boxes": [{**ROW, "heading": 1}]}, 'the nearest valid key is "yaw"'),
        ({"boxes": [{**ROW, "": 1}]}, "boxes: row 0: unknown key ''"),
    ],
)
def test_bad_document_names_source_row_and_field(document: Any, expected: str) -> None:
    with pytest.raises(ValueError) as caught:
        from_dict(document, source="left.json")
    assert str(caught.value).startswith("left.json: ")
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


DEEP = "[" * 200_000


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        (b"", "not JSON: Expecting value (line 1, column 1)"),
        (b"x: 1", "not JSON: Expecting value"),
        (b'{"boxes": [', "not JSON:"),
        (b'{"boxes": []} {}', "not JSON: Extra data"),
        (b"\xff\xfe", "not JSON: not UTF-8 text (byte 0)"),
        (b"[" + b"9" * 5000 + b"]", "unreadable JSON"),
        (DEEP.encode(), "unreadable JSON"),
        (b"[]", "must be a JSON object"),
        (b'{"boxes": [{"x": NaN, "y": 0, "l": 1, "w": 1, "yaw": 0}]}', "boxes: row 0: x must be a finite number"),
        (b'{"boxes": [{"x": 0, "y": -Infinity, "l": 1, "w": 1, "yaw": 0}]}', "boxes: row 0: y must be a finite number"),
        (b'{"boxes": [{"x": 0, "y": 1e999, "l": 1, "w": 1, "yaw": 0}]}', "boxes: row 0: y must be a finite number"),
        (b'{"boxes": [{"x": 0, "y": 0, "l": 1, "w": 1, "yaw": 0, "x": 1}]}', "boxes: row 0: the key 'x' comes twice"),
        (b'{"boxes": [], "boxes": []}', "the key 'boxes' comes twice"),
    ],
)
def test_bad_file_is_named_in_one_line(tmp_path: Path, content: bytes, expected: str) -> None:
    path = tmp_path / "left.json"
    path.write_bytes(content)
    with pytest.raises(ValueError) as caught:
        read_object_list(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert expected in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_byte_order_mark_is_no_error(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_bytes(b'\xef\xbb\xbf{"boxes": []}')
    assert len(read_object_list(tmp_path / "a.json")) == 0


def test_missing_file_raises_the_system_error(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"missing\.json"):
        read_object_list(tmp_path / "missing.json")


leaves: st.SearchStrategy[Any] = st.sampled_from(
    [None, True, 0, -1, 2**70, 0.5, math.nan, math.inf, "", "1.0", [], {}, [1.0]]
)
rows = st.fixed_dictionaries(dict.fromkeys(["x", "y", "l", "w", "yaw"], leaves | st.just(1.0)), optional={"id": leaves})
documents = (
    leaves | st.lists(leaves | rows, max_size=3) | st.lists(leaves | rows, max_size=3).map(lambda b: {"boxes": b})
)


@given(documents)
def test_any_document_parses_or_raises_one_line(document: Any) -> None:
    message = ""
    try:
        from_dict(document)
    except ValueError as error:
        message = str(error)
    assert "\n" not in message
