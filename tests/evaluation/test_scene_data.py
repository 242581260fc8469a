"""Sequences of simulated scenes: the truth fits the lists, late or not."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from scipy.spatial import cKDTree

from cobevglue.disturbance.detection_errors import DetectionErrors
from cobevglue.evaluation.alignment import AlignmentSequence, PairFrame
from cobevglue.evaluation.scene_data import scene_of, scene_sequence, scene_sequences
from cobevglue.simulation.object_lists import SensorSettings
from cobevglue.simulation.object_scenes import SCENES, Mast

PERFECT = SensorSettings(errors=DetectionErrors.none())
DURATION = 2.0


@cache
def sequence(name: str, seed: int, delay: float = 0.0, jitter: float = 0.0) -> AlignmentSequence:
    """Noise-free lists."""
    return scene_sequence(name, seed, delay, jitter, DURATION, PERFECT)


def content(frame: PairFrame) -> tuple[object, ...]:
    """Every number of a frame."""
    assert frame.pairs is not None
    return (frame.ego.bev.tobytes(), frame.other.bev.tobytes(), frame.ego_SE2_other, frame.pairs.tobytes())


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("seed", [0, 5])
def test_common_objects_coincide_under_the_true_pose(name: str, seed: int) -> None:
    frames = sequence(name, seed).frames
    assert len(frames) == 20
    assert sum(frame.co_visible for frame in frames) > 20
    for frame in frames:
        assert frame.pairs is not None
        assert frame.time_offset == 0.0
        m, n = frame.pairs.T
        moved = frame.other.transform(frame.ego_SE2_other)
        np.testing.assert_allclose(moved.center[n, :2], frame.ego.center[m, :2], atol=1e-9)


@pytest.mark.parametrize("name", SCENES)
def test_late_list_is_earlier_list_under_present_pose(name: str) -> None:
    on_time, late = sequence(name, 1), sequence(name, 1, 0.2)
    for now, before, frame in zip(on_time.frames[2:], on_time.frames, late.frames[2:], strict=False):
        assert frame.time_offset == -0.2
        assert frame.ego_SE2_other == now.ego_SE2_other, "the pose is that at the ego's instant"
        np.testing.assert_array_equal(frame.ego.bev, now.ego.bev)
        np.testing.assert_allclose(frame.other.bev, before.other.bev, atol=1e-9)


@pytest.mark.parametrize("name", SCENES)
@pytest.mark.parametrize("delay", [0.137, 0.3, -0.15])
def test_moving_boxes_by_true_velocity_undoes_the_delay(name: str, delay: float) -> None:
    scene = scene_of(name, 2, DURATION)
    ego, other = scene.agents
    moving = 0
    for frame in sequence(name, 2, delay).frames[::5]:
        assert frame.pairs is not None
        assert frame.time is not None
        listed = frame.time - delay
        world_SE2_ego, world_SE2_list = scene.pose(ego, frame.time), scene.pose(other, listed)
        m, n = frame.pairs.T
        then = world_SE2_list.apply(frame.other.center[n, :2])
        now = world_SE2_ego.apply(frame.ego.center[m, :2])
        before, at, after = (scene.traffic.at(t).center[:, :2] for t in (listed - 1e-3, listed, listed + 1e-3))
        gap, row = cKDTree(at).query(then)
        assert gap.max() < 1e-9, "each listed box is a true one at the instant of the list"
        velocity = (after - before)[row] / 2e-3
        np.testing.assert_allclose(then + delay * velocity, now, atol=0.3, err_msg="accelerations of some m/s^2")
        moving += int((np.hypot(*velocity.T) > 3.0).sum())
        pose = world_SE2_ego.inverse() @ scene.pose(other, frame.time)
        assert pose.error_to(frame.ego_SE2_other)[0] < 1e-9
    assert moving > 2 or name in ("car park", "mast")


@pytest.mark.parametrize("name", SCENES)
def test_bodies_are_the_agents_own_vehicles(name: str) -> None:
    scene = scene_of(name, 0, DURATION)
    for frame in sequence(name, 0).frames[::5]:
        assert frame.time is not None
        boxes = scene.traffic.at(frame.time)
        for (agent, carrier), body in zip(scene.agents.items(), (frame.ego_body, frame.other_body), strict=True):
            if isinstance(carrier, Mast):
                assert body is None
                continue
            assert body is not None
            np.testing.assert_allclose(body.transform(scene.pose(agent, frame.time)).bev, boxes[carrier].bev)


def test_jitter_changes_the_age_of_each_list() -> None:
    offsets = np.array([frame.time_offset for frame in sequence("junction", 0, 0.1, 0.04).frames])
    assert np.abs(offsets + 0.1).max() <= 0.04
    assert offsets.std() > 0.01


def test_seed_determines_sequence() -> None:
    first, again = (scene_sequence("motorway", 3, 0.1, duration=0.5) for _ in range(2))
    different, *_ = scene_sequences("motorway", [4], 0.1, duration=0.5)
    assert [content(f) for f in first.frames] == [content(f) for f in again.frames]
    assert content(first.frames[0]) != content(different.frames[0])
    assert (first.name, different.name) == ("motorway/3", "motorway/4")


def test_delay_leaves_the_egos_lists_alone() -> None:
    on_time, late = (scene_sequence("roundabout", 0, delay, duration=0.5) for delay in (0.0, 0.3))
    for a, b in zip(on_time.frames, late.frames, strict=True):
        np.testing.assert_array_equal(a.ego.bev, b.ego.bev)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"name": "motorwya"}, "no scene 'motorwya'; there are motorway, junction"),
        ({"delay": 1.2}, r"delay must be within 1.0 s, jitter included, got 1.2"),
        ({"delay": 0.99, "jitter": 0.04}, "delay must be within"),
        ({"delay": float("nan")}, "delay must be within"),
        ({"jitter": 0.05}, "jitter must be at least 0 and below 0.05 s, got 0.05"),
    ],
)
def test_invalid_argument_is_named(change: dict[str, object], message: str) -> None:
    arguments: dict[str, object] = {"name": "junction", "seed": 0} | change
    with pytest.raises(ValueError, match=message):
        scene_sequence(**arguments)  # type: ignore[arg-type]
