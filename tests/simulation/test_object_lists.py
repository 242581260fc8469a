"""The junction as object lists: what each agent detects, and the truth that goes with it."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from cobevglue.boxes import Boxes
from cobevglue.disturbance.detection_errors import DetectionErrors
from cobevglue.se2 import wrap_angle
from cobevglue.simulation import Junction, JunctionSettings, ObjectListFrame

PERFECT = JunctionSettings(errors=DetectionErrors.none())


def content(frame: ObjectListFrame) -> bytes:
    """Every number of a frame."""
    parts = [frame.objects.bev.tobytes()]
    for view in frame.agents.values():
        assert view.boxes.score is not None
        parts += [view.boxes.bev.tobytes(), view.boxes.score.tobytes(), view.object_id.tobytes()]
    return b"".join(parts)


def test_default_scene_is_80_frames_of_two_agents() -> None:
    scene = Junction()
    frames = list(scene)
    assert len(scene) == len(frames) == 80
    assert [frame.index for frame in frames] == list(range(80))
    np.testing.assert_allclose([frame.time for frame in frames], np.arange(80) / 10)
    assert all(list(frame.agents) == ["car1", "car2"] for frame in frames)


@pytest.mark.parametrize("seed", range(5))
def test_default_scene_has_enough_common_objects(seed: int) -> None:
    frames = list(Junction(seed))[::4]
    visible = [len(view.visible) for frame in frames for view in frame.agents.values()]
    common = [len(frame.matches("car1", "car2")) for frame in frames]
    assert 12 <= np.median(visible) <= 28
    assert 5 <= np.median(common) <= 16
    assert min(common) < np.median(common) < max(common), "some frames are harder than others"


def test_same_seed_gives_same_bytes_in_any_order() -> None:
    first, again = Junction(3), Junction(3)
    backwards = [content(again[i]) for i in (79, 40, 0)]
    assert [content(first[i]) for i in (79, 40, 0)] == backwards
    assert content(first[40]) == content(again[40])
    assert content(Junction(4)[40]) != content(first[40])


def test_consecutive_frames_have_different_errors() -> None:
    scene = Junction(0)
    a, b = scene[10].agents["car1"], scene[11].agents["car1"]
    assert a.object_id.tolist() != b.object_id.tolist() or not np.allclose(a.boxes.size, b.boxes.size)


def test_perfect_detections_are_true_objects_in_frame() -> None:
    for frame in list(Junction(1, PERFECT))[::20]:
        for view in frame.agents.values():
            in_world = view.boxes.transform(view.world_SE2_agent)
            truth = frame.objects[view.object_id]
            np.testing.assert_allclose(in_world.center, truth.center, atol=1e-9)
            np.testing.assert_allclose(in_world.size, truth.size)
            np.testing.assert_allclose(wrap_angle(in_world.yaw - truth.yaw), 0.0, atol=1e-9)
            assert in_world.label is not None
            assert truth.label is not None
            assert in_world.label.tolist() == truth.label.tolist()


def test_true_pose_aligns_matched_objects() -> None:
    for frame in list(Junction(2, PERFECT))[::10]:
        ego, other = frame.agents["car1"].boxes, frame.agents["car2"].boxes
        matches = frame.matches("car1", "car2")
        assert len(matches) > 0
        moved = other.transform(frame.ego_SE2_other("car1", "car2"))
        np.testing.assert_allclose(moved.center[matches[:, 1]], ego.center[matches[:, 0]], atol=1e-9)


def test_matches_are_true_pairs_and_swap() -> None:
    frame = Junction(0, JunctionSettings(errors=DetectionErrors(false_per_frame=10.0)))[40]
    matches = frame.matches("car1", "car2")
    ids = frame.agents["car1"].object_id[matches[:, 0]]
    assert (ids >= 0).all()
    assert (ids == frame.agents["car2"].object_id[matches[:, 1]]).all()
    assert (frame.agents["car1"].object_id == -1).sum() > 3, "there are false boxes to confuse"
    assert {tuple(pair) for pair in matches[:, ::-1]} == {tuple(pair) for pair in frame.matches("car2", "car1")}


def test_an_agent_sees_the_others_but_not_itself() -> None:
    seen_by_each_other = 0
    for frame in Junction(0, PERFECT):
        for view in frame.agents.values():
            assert view.own_id not in view.object_id
        seen_by_each_other += 1 in frame.agents["car1"].object_id
    assert seen_by_each_other > 10


def test_agents_start_on_different_arms_and_drive() -> None:
    scene = Junction(0, JunctionSettings(agents=4))
    first, last = scene[0], scene[79]
    starts = np.array([view.world_SE2_agent.translation for view in first.agents.values()])
    assert len({tuple(np.sign(np.round(start, -1))) for start in starts}) == 4
    for name, view in first.agents.items():
        moved, _ = last.agents[name].world_SE2_agent.error_to(view.world_SE2_agent)
        assert moved > 20


def test_nothing_beyond_the_sensors_range_is_seen() -> None:
    frame = Junction(0, JunctionSettings(sensor_range=25.0, errors=DetectionErrors.none()))[40]
    for view in frame.agents.values():
        assert np.hypot(*view.boxes.center[:, :2].T).max() <= 25.0


def test_hidden_objects_are_not_seen() -> None:
    hidden = Junction(0, PERFECT.model_copy(update={"min_visible": 0.3}))
    through = Junction(0, PERFECT.model_copy(update={"min_visible": 0.0}))
    count = [sum(len(f.agents["car1"].visible) for f in scene) for scene in (hidden, through)]
    assert count[0] < 0.9 * count[1]


def test_one_agent_and_one_vehicle_is_valid() -> None:
    frame = Junction(0, JunctionSettings(agents=1, vehicles=1, errors=DetectionErrors.none()))[0]
    assert len(frame.agents["car1"].boxes) == 0
    assert frame.agents["car1"].object_id.shape == (0,)
    assert isinstance(frame.objects, Boxes)


def test_negative_indices_work_within_range() -> None:
    scene = Junction(0, JunctionSettings(duration=1.0))
    assert scene[-1].index == 9
    for index in (10, -11):
        with pytest.raises(IndexError, match="of a scene of 10"):
            scene[index]


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"agents": 0}, "agents"),
        ({"agents": 9}, "agents"),
        ({"vehicles": 101}, "vehicles"),
        ({"duration": 0.0}, "duration"),
        ({"rate": -1.0}, "rate"),
        ({"min_visible": 1.5}, "min_visible"),
        ({"vehicle": 3}, "vehicle"),
    ],
)
def test_invalid_setting_is_named(changes: dict[str, Any], field: str) -> None:
    with pytest.raises(ValidationError, match=field):
        JunctionSettings(**changes)


def test_fewer_vehicles_than_agents_is_an_error() -> None:
    with pytest.raises(ValueError, match=r"vehicles \(1\) must be at least agents \(2\)"):
        Junction(0, JunctionSettings(vehicles=1))
