"""Own object lists as lines of JSON."""

from __future__ import annotations

import json

import pytest

from cobevglue import Boxes
from cobevglue.node import OwnList, parse_list, write_list

CAR = {"x": 1.0, "y": 2.0, "l": 4.5, "w": 1.9, "yaw": 0.1}


def test_line_and_back() -> None:
    boxes = Boxes([(1, 2, 3), (4, 5, 6)], [(4.5, 1.9, 1.5)] * 2, [0.1, 0.2], label=["car", "van"])
    own = parse_list(write_list(OwnList(boxes, 12.5, boxes[:1].replace(label=None))), 99.0)
    assert own.time == 12.5
    assert own.boxes.center.tolist() == boxes.center.tolist()
    assert own.body is not None
    assert own.body.center.tolist() == [[1, 2, 3]]


def test_time_and_body_may_be_left_out() -> None:
    own = parse_list(json.dumps({"boxes": [CAR]}).encode(), 99.0)
    assert (own.time, own.body, len(own.boxes)) == (99.0, None, 1)


@pytest.mark.parametrize(
    ("line", "expected"),
    [
        ("nonsense", "not JSON"),
        (b"\xff\xfe", "not JSON"),
        ("[" * 100_000, "not JSON"),
        ("[1, 2]", "must be a JSON object"),
        ('{"time": 1}', '"boxes" is missing'),
        ('{"boxes": [], "time": "now"}', "time must be a finite number"),
        ('{"boxes": [], "time": true}', "time must be a finite number"),
        ('{"boxes": [], "time": NaN}', "time must be a finite number"),
        ('{"boxes": [], "time": 1e400}', "time must be a finite number"),
        ('{"boxes": [], "times": 1}', "unknown key 'times'"),
        (json.dumps({"boxes": [CAR, {**CAR, "l": -1}]}), "row 1"),
        (json.dumps({"boxes": [], "body": {"x": 0}}), 'body: boxes: row 0: the key "y" is missing'),
        (json.dumps({"boxes": [], "body": 5}), "body: boxes: row 0 must be an object"),
    ],
)
def test_bad_line_is_one_line_of_error(line: str | bytes, expected: str) -> None:
    with pytest.raises(ValueError, match=expected) as error:
        parse_list(line, 0.0)
    assert "\n" not in str(error.value)
