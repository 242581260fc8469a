"""An agent's own vehicle takes part in the alignment as an object that only the other agent detects."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cobevglue import SE2, BEVGlue, Boxes
from cobevglue.alignment.alignment import Alignment
from cobevglue.alignment.own_body import append_body, check_bodies

CAR = (4.5, 1.9, 1.6)
BODY = Boxes([(0.0, 0.0, -1.0)], [CAR], [0.0])
TRUTH = SE2(30.0, 6.0, math.radians(170.0))


def cars(*rows: tuple[float, float, float], first_id: int = 0) -> Boxes:
    """Cars at x, y [m] with a heading [degrees], with track ids."""
    xy = [(x, y, -1.0) for x, y, _ in rows]
    yaw = [math.radians(degrees) for _, _, degrees in rows]
    return Boxes(xy, [CAR] * len(rows), yaw, track_id=list(range(first_id, first_id + len(rows))))


@pytest.mark.parametrize(
    ("boxes", "ids"),
    [
        (cars((5, 0, 0), (9, 2, 0)), [0, 1, 2**52]),
        (cars((5, 0, 0)).replace(track_id=None), None),  # without ids there is none for the vehicle either
        (cars((5, 0, 0)).replace(score=[0.5]), [0, 2**52]),  # a vehicle has no score: dropped
        (Boxes.empty(), None),
    ],
)
def test_body_is_the_last_row(boxes: Boxes, ids: list[int] | None) -> None:
    appended = append_body(boxes, BODY, "ego_body")
    assert len(appended) == len(boxes) + 1
    np.testing.assert_array_equal(appended.center[-1], BODY.center[0])
    np.testing.assert_array_equal(appended.center[:-1], boxes.center)
    assert (None if appended.track_id is None else appended.track_id.tolist()) == ids
    assert append_body(boxes, None, "ego_body") is boxes


@pytest.mark.parametrize("rows", [0, 2])
def test_body_has_exactly_one_row(rows: int) -> None:
    body = Boxes.concatenate([BODY] * rows) if rows else Boxes.empty()
    with pytest.raises(ValueError, match=f"other_body must have one row, got {rows}"):
        BEVGlue().align(cars((5, 0, 0)), cars((5, 0, 0)), other_body=body)


def test_mutual_sighting_gives_the_pose() -> None:
    """Each sees the other and one object of its own; nothing else is common. Both drive on, so time speaks, too."""
    with_bodies, without = BEVGlue(), BEVGlue()
    for frame in range(12):
        ego_SE2_other = SE2(30.0 - 1.5 * frame, 6.0, TRUTH.yaw)
        there, back = ego_SE2_other, ego_SE2_other.inverse()
        ego = cars((there.x, there.y, math.degrees(there.yaw)), (12.0, -20.0, 90.0))
        other = cars((back.x, back.y, math.degrees(back.yaw)), (-15.0, 25.0, 30.0), first_id=7)
        alignment = with_bodies.align(ego, other, ego_body=BODY, other_body=BODY)
        assert not without.align(ego, other).accepted
    assert alignment.ego_SE2_other is not None
    translation, yaw = alignment.ego_SE2_other.error_to(ego_SE2_other)
    assert translation < 0.1
    assert yaw < math.radians(0.5)
    assert len(alignment.matches) == 0, "both pairs have an own vehicle, which is no row of the lists"


def test_overlapping_own_vehicles_are_refused() -> None:
    """One of two cars in a row sees both ahead, the other behind: the pose that unites the cars is impossible."""
    alignment = Alignment(SE2(1.0, 0.5, 0.1), np.array([[0, 0], [1, 1]]), np.eye(3))
    refused = check_bodies(alignment, cars((5, 0, 0), (9, 2, 0)), cars((5, 0, 0), (9, 2, 0)), BODY, BODY)
    assert not refused.accepted
    assert "into each other" in refused.reason


def test_matches_of_bodies_are_not_listed() -> None:
    alignment = Alignment(TRUTH, np.array([[0, 1], [1, 2], [2, 0]]), np.eye(3))
    checked = check_bodies(alignment, cars((5, 0, 0), (9, 2, 0)), cars((5, 0, 0), (9, 2, 0)), BODY, BODY)
    assert checked.matches.tolist() == [[0, 1]]
    assert checked.ego_SE2_other == TRUTH
