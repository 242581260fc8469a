"""Messages that are made up, lost or late."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from cobevglue.boxes import Boxes
from cobevglue.disturbance import Delay, FabricatedBoxes, MessageLoss
from cobevglue.messages import ObjectMessage, decode, encode

from .drives import KEY, drive

FRAMES = drive()


def test_fabricated_boxes_are_added_behind_the_true_ones() -> None:
    heard = FabricatedBoxes(count=6, reach=30.0).apply(FRAMES, 3, "ego", KEY)
    assert heard.observations["ego"] is FRAMES[3].observations["ego"]
    for agent in ("car2", "car3"):
        view, before = heard.observations[agent], FRAMES[3].observations[agent]
        assert (view.boxes.center[:2] == before.boxes.center).all()
        assert len(view.boxes) == len(view.variance) == len(view.detections) == 8
        assert np.hypot(*view.boxes.center[2:, :2].T).max() <= 30.0
        assert view.features is before.features


def test_fabricated_boxes_keep_ids_and_follow_their_agent() -> None:
    attack = FabricatedBoxes(count=4)
    first, later = (attack.apply(FRAMES, index, "ego", KEY).observations for index in (0, 9))
    np.testing.assert_array_equal(first["car2"].boxes.center[2:], later["car2"].boxes.center[2:])
    assert first["car2"].boxes.track_id is not None
    assert later["car2"].boxes.track_id is not None
    assert first["car2"].boxes.track_id[2:].tolist() == later["car2"].boxes.track_id[2:].tolist()
    assert (first["car2"].boxes.center[2:] != first["car3"].boxes.center[2:]).any()


def test_fabricated_boxes_are_sendable_and_sorted() -> None:
    view = FabricatedBoxes(count=3).apply(FRAMES, 0, "ego", KEY).observations["car2"]
    assert view.detections.score is not None
    assert view.detections.score.tolist() == [0.9, 0.9, 0.9, 0.8, 0.4]
    received = decode(encode(ObjectMessage("car2", 0.0, 0, view.boxes))).boxes
    assert received.track_id is not None
    assert view.boxes.track_id is not None
    assert received.track_id.tolist() == view.boxes.track_id.tolist()


def test_empty_list_can_get_fabricated_boxes() -> None:
    blind = replace(
        FRAMES[0].observations["car2"], boxes=Boxes.empty(), variance=np.zeros((0, 3)), detections=Boxes.empty()
    )
    frame = replace(FRAMES[0], observations={**FRAMES[0].observations, "car2": blind})
    view = FabricatedBoxes(count=3).apply([frame], 0, "ego", KEY).observations["car2"]
    assert len(view.boxes) == len(view.variance) == len(view.detections) == 3


@pytest.mark.parametrize(("probability", "there"), [(0.0, 600), (0.25, 450), (1.0, 0)])
def test_loss_drops_whole_collaborators_this_often(probability: float, there: int) -> None:
    frames = drive(300)
    heard = [MessageLoss(probability=probability).apply(frames, index, "ego", KEY) for index in range(300)]
    assert sum(len(frame.collaborators("ego")) for frame in heard) == pytest.approx(there, abs=40)
    assert all("ego" in frame.observations for frame in heard)
    assert all(frame.observations.keys() == frame.claimed.keys() == frame.true.keys() for frame in heard)


@pytest.mark.parametrize(("seconds", "frames"), [(0.0, 0), (0.1, 1), (0.25, 3), (0.3, 3)])
def test_late_messages_carry_old_observations_and_poses(seconds: float, frames: int) -> None:
    heard, now, then = Delay(seconds=seconds).apply(FRAMES, 8, "ego", KEY), FRAMES[8], FRAMES[8 - frames]
    assert heard.observations["ego"] is now.observations["ego"]
    assert heard.observations["car2"] is then.observations["car2"]
    assert heard.claimed["car2"] is then.claimed["car2"]
    assert heard.true["car2"] is then.true["car2"]
    assert heard.time == now.time


def test_before_first_late_message_ego_is_alone() -> None:
    heard = Delay(seconds=0.3).apply(FRAMES, 2, "ego", KEY)
    assert list(heard.observations) == list(heard.claimed) == list(heard.true) == ["ego"]


def test_late_messages_respect_arrival_and_departure() -> None:
    came = [frame.without("car3") if i < 5 else frame for i, frame in enumerate(FRAMES)]
    assert "car3" not in Delay(seconds=0.2).apply(came, 6, "ego", KEY).observations
    assert "car3" in Delay(seconds=0.2).apply(came, 7, "ego", KEY).observations
    assert "car2" not in Delay(seconds=0.2).apply(drive(second_leaves=6), 6, "ego", KEY).observations
