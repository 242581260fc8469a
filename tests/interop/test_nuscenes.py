"""nuScenes records: a hand-made annotation, round trips through tilted frames, bad records."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from cobevglue import Boxes
from cobevglue.interop import SE3_from_nuscenes, boxes_from_nuscenes, nuscenes_from_boxes

HALF = math.sqrt(0.5)
# The vehicle is at (100, 200), looking north (+y of the global frame).
EGO_POSE = {"translation": [100.0, 200.0, 0.0], "rotation": [HALF, 0.0, 0.0, HALF]}
# A car 10 m ahead of it and 2 m to its left, which looks west (-x of the global frame): to the left, as the ego has it.
CAR = {
    "translation": [98.0, 210.0, 1.0],
    "size": [1.9, 4.5, 1.6],
    "rotation": [0.0, 0.0, 0.0, 1.0],
    "instance_token": "a1b2",
    "category_name": "vehicle.car",
}


def test_annotation_in_the_vehicle_frame() -> None:
    boxes = boxes_from_nuscenes([CAR], SE3_from_nuscenes(EGO_POSE))
    np.testing.assert_allclose(boxes.center, [[10.0, 2.0, 1.0]], atol=1e-12)
    np.testing.assert_allclose(boxes.size, [[4.5, 1.9, 1.6]])
    np.testing.assert_allclose(boxes.yaw, [math.pi / 2])
    assert boxes.label is not None
    assert boxes.label.tolist() == ["vehicle.car"]
    assert boxes.score is None
    assert boxes.track_id is None


def test_ids_stay_the_same_over_samples() -> None:
    numbers: dict[str, int] = {}
    boxes_from_nuscenes([CAR], numbers_of_ids=numbers)
    later = boxes_from_nuscenes([CAR | {"instance_token": "ffff"}, CAR], numbers_of_ids=numbers)
    assert later.track_id is not None
    assert later.track_id.tolist() == [1, 0]
    assert numbers == {"a1b2": 0, "ffff": 1}


@given(
    st.lists(
        st.tuples(*[st.floats(-100, 100)] * 3, *[st.floats(0.1, 20)] * 3, st.floats(-3.1, 3.1)), min_size=1, max_size=4
    ),
    st.tuples(st.floats(-180, 180), st.floats(-20, 20), st.floats(-20, 20)),
    st.tuples(*[st.floats(-1000, 1000)] * 3),
)
def test_round_trip_through_any_frame(rows: list[Any], turn: Any, shift: Any) -> None:
    table = np.array(rows)
    boxes = Boxes(
        table[:, :3], table[:, 3:6], table[:, 6], score=np.linspace(0, 1, len(table)), label=["car"] * len(rows)
    )
    frame = np.eye(4)
    frame[:3, :3] = Rotation.from_euler("ZYX", turn, degrees=True).as_matrix()
    frame[:3, 3] = shift
    back = boxes_from_nuscenes(nuscenes_from_boxes(boxes, frame), frame)
    np.testing.assert_allclose(back.center, boxes.center, atol=1e-9)
    np.testing.assert_array_equal(back.size, boxes.size)
    np.testing.assert_allclose(back.yaw, boxes.yaw, atol=1e-9)
    assert back.score is not None
    assert back.label is not None
    np.testing.assert_array_equal(back.score, boxes.score)
    assert back.label.tolist() == ["car"] * len(rows)


def test_tracks_are_written_as_tracking_results() -> None:
    boxes = Boxes([(1, 2, 3)], [(4, 2, 1)], [0.0], score=[0.5], track_id=[7], label=["car"])
    record = nuscenes_from_boxes(boxes)[0]
    assert record == {
        "translation": [1, 2, 3],
        "size": [2, 4, 1],
        "rotation": [1, 0, 0, 0],
        "tracking_id": "7",
        "tracking_name": "car",
        "tracking_score": 0.5,
    }


def test_records_come_in_the_frame_of_the_records() -> None:
    box = boxes_from_nuscenes([CAR])
    np.testing.assert_allclose(box.bev, [[98.0, 210.0, 4.5, 1.9, math.pi]])


def test_no_records_are_no_boxes() -> None:
    assert len(boxes_from_nuscenes([], np.eye(4), {})) == 0
    assert nuscenes_from_boxes(Boxes.empty()) == []


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"rotation": [1, 0, 0]}, "records: row 1: rotation must be 4 finite numbers"),
        ({"rotation": [2, 0, 0, 0]}, "records: row 1: rotation must be a unit quaternion"),
        ({"translation": [1, 2, math.nan]}, "records: row 1: translation must be 3 finite numbers"),
        ({"size": "big"}, "records: row 1: size must be 3 finite numbers, got 'big'"),
        ({"size": [0, 1, 1]}, "size: row 1"),
    ],
)
def test_bad_record_is_named(change: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        boxes_from_nuscenes([CAR, CAR | change])


def test_missing_field_is_named() -> None:
    with pytest.raises(ValueError, match="records: row 0: size is missing"):
        boxes_from_nuscenes([{name: CAR[name] for name in ("translation", "rotation")}])
