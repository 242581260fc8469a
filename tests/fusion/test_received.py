"""Boxes of a late message, brought to the ego's instant."""

from __future__ import annotations

import numpy as np
import pytest

from cobevglue import SE2, Alignment, Boxes
from cobevglue.fusion.method import Received

CAR = (4.5, 1.9, 1.6)
LATE = -0.2
"""Time offset of the list [s]."""
POSE = SE2(10.0, 0.0, np.pi / 2)
SPEED = 5.0
"""Of the other agent, which drives straight on [m/s]."""


def cars(*centers: tuple[float, float]) -> Boxes:
    return Boxes([(x, y, 0.0) for x, y in centers], [CAR] * len(centers), [0.0] * len(centers))


def received(velocity: list[tuple[float, float]], aligned: Boxes) -> Received:
    """The list is 0.2 s old: since then the other's frame has moved on by 1 m."""
    list_pose = POSE @ SE2(SPEED * LATE, 0.0, 0.0)
    alignment = Alignment(POSE, time_offset=LATE, ego_SE2_list=list_pose, other_velocity=np.array(velocity))
    return Received({}, list_pose, alignment, aligned)


@pytest.mark.parametrize(
    ("velocity", "expected"),
    [
        pytest.param((-SPEED, 0.0), (10.0, 19.0), id="it stands still: where the pose at the list's instant puts it"),
        pytest.param((0.0, 0.0), (10.0, 20.0), id="it drives along with the other agent, 1 m further"),
        pytest.param((-SPEED, 10.0), (8.0, 19.0), id="it crosses to the left at 10 m/s, 2 m further"),
    ],
)
def test_aligned_box_moves_with_its_velocity(velocity: tuple[float, float], expected: tuple[float, float]) -> None:
    aligned = cars((20.0, 0.0))
    found = received([velocity], aligned).boxes_at_ego_instant(cars((20.0, 0.0)))
    np.testing.assert_allclose(found.center[0, :2], expected, atol=1e-9)
    assert found.yaw[0] == pytest.approx(np.pi / 2)


def test_box_without_aligned_box_stands_still() -> None:
    found = received([(0.0, 0.0)], cars((20.0, 0.0))).boxes_at_ego_instant(cars((20.0, 8.0)))
    np.testing.assert_allclose(found.center[0, :2], (2.0, 19.0), atol=1e-9)


def test_message_of_ego_instant_is_transformed() -> None:
    boxes = cars((20.0, 0.0), (3.0, 4.0))
    found = Received({}, POSE).boxes_at_ego_instant(boxes)
    np.testing.assert_allclose(found.center, boxes.transform(POSE).center)
