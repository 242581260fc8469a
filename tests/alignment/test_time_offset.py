"""The time offset of the other agent's lists, and the velocities of its tracks."""

from __future__ import annotations

import math

import numpy as np
import pytest

from cobevglue import SE2, Alignment, BEVGlue, BEVGlueConfig, Boxes
from cobevglue.alignment import track_motion
from cobevglue.alignment.box_rows import box_rows, track_ids
from cobevglue.alignment.frame_motion import FrameMotion
from cobevglue.alignment.track_motion import TRACK, TrackNoise
from cobevglue.typing import FloatArray

SPEEDS = np.array([14.0, -14.0, 12.0, -12.0, 0.0, 0.0, 0.0, 0.0, 0.0, 13.0, 0.0, 0.0])
"""Of twelve vehicles along the road [m/s]."""
FRAMES = 30


def vehicles(time: float) -> Boxes:
    """In the world: five that drive, both ways, and seven that are parked."""
    rng = np.random.default_rng(5)
    n = len(SPEEDS)
    x, y = rng.uniform(-40.0, 40.0, n), rng.uniform(-25.0, 25.0, n)
    center = np.column_stack([x + SPEEDS * time, y, np.zeros(n)])
    size = np.column_stack([rng.uniform(4.0, 5.5, n), rng.uniform(1.7, 2.1, n), np.full(n, 1.6)])
    return Boxes(center, size, np.where(SPEEDS < 0.0, math.pi, 0.0), track_id=np.arange(n))


def world_SE2_other(time: float) -> SE2:
    """The other agent drives at 8 m/s and turns at 0.1 rad/s."""
    yaw = 0.4 + 0.1 * time
    return SE2(10.0 + 80.0 * (math.sin(yaw) - math.sin(0.4)), -3.0 - 80.0 * (math.cos(yaw) - math.cos(0.4)), yaw)


WORLD_SE2_EGO = SE2(-12.0, 2.0, -0.2)


def observed(time: float, world_SE2_agent: SE2, seed: int) -> Boxes:
    """The vehicles in an agent's frame, with 0.1 m of noise."""
    boxes = vehicles(time).transform(world_SE2_agent.inverse())
    noise = np.random.default_rng([seed, round(time * 1000)]).normal(0.0, 0.1, (len(boxes), 2))
    return boxes.replace(center=boxes.center + np.column_stack([noise, np.zeros(len(boxes))]))


def last_alignment(age: float, config: BEVGlueConfig, stamped: float | None = None) -> tuple[Alignment, Boxes]:
    """The last of thirty frames in which the other's list is `age` seconds old, and that list."""
    glue = BEVGlue(config)
    for frame in range(FRAMES):
        time = 1.0 + 0.1 * frame
        other = observed(time - age, world_SE2_other(time - age), 1)
        other_time = None if stamped is None else time + stamped
        alignment = glue.align(observed(time, WORLD_SE2_EGO, 0), other, time, other_time)
    return alignment, other


@pytest.mark.parametrize("age", [0.0, 0.1, 0.2, 0.3])
def test_offset_and_pose_at_ego_instant_are_estimated(age: float) -> None:
    alignment, _ = last_alignment(age, BEVGlueConfig())
    assert alignment.time_offset == pytest.approx(-age, abs=0.03)
    assert alignment.time_offset_std < 0.05
    assert alignment.ego_SE2_other is not None
    now = 1.0 + 0.1 * (FRAMES - 1)
    translation, yaw = alignment.ego_SE2_other.error_to(WORLD_SE2_EGO.inverse() @ world_SE2_other(now))
    assert translation < 0.6
    assert yaw < math.radians(1.0)
    assert alignment.ego_SE2_list is not None
    then = WORLD_SE2_EGO.inverse() @ world_SE2_other(now - age)
    assert alignment.ego_SE2_list.error_to(then)[0] < 0.4


def test_boxes_are_brought_to_ego_instant() -> None:
    """Those of a list 0.3 s old lie up to 4 m off as they are."""
    alignment, other = last_alignment(0.3, BEVGlueConfig())
    truth = vehicles(1.0 + 0.1 * (FRAMES - 1)).transform(WORLD_SE2_EGO.inverse())
    gap = np.linalg.norm(alignment.boxes_at_ego_instant(other).center - truth.center, axis=1)
    assert gap.max() < 1.2
    assert alignment.ego_SE2_other is not None
    as_they_are = np.linalg.norm(other.transform(alignment.ego_SE2_other).center - truth.center, axis=1)
    assert as_they_are.max() > 2.0


def test_time_stamp_of_other_is_the_prior() -> None:
    """On one clock the stamps tell the offset; clocks that differ by more than a second are two."""
    one_clock, _ = last_alignment(0.3, BEVGlueConfig(stamped_offset_std=0.01), stamped=-0.3)
    assert one_clock.time_offset == pytest.approx(-0.3, abs=0.01)
    two_clocks, _ = last_alignment(0.1, BEVGlueConfig(), stamped=1000.0)
    assert two_clocks.time_offset == pytest.approx(-0.1, abs=0.03)


def test_offset_keeps_its_prior_where_nothing_moves() -> None:
    glue = BEVGlue(BEVGlueConfig())
    parked = vehicles(0.0)[SPEEDS == 0.0]
    for _ in range(20):
        alignment = glue.align(parked, parked.transform(SE2(5.0, 1.0, 0.3)))
    assert alignment.time_offset == pytest.approx(0.0, abs=1e-6)
    assert alignment.time_offset_std > 0.14


def test_offset_is_zero_where_it_is_not_estimated() -> None:
    alignment, other = last_alignment(0.0, BEVGlueConfig(time_offset=False))
    assert alignment.time_offset == 0.0
    assert math.isnan(alignment.time_offset_std)
    assert alignment.ego_SE2_other is not None
    expected = other.transform(alignment.ego_SE2_other).center
    np.testing.assert_allclose(alignment.boxes_at_ego_instant(other).center, expected)


def test_other_time_must_be_finite() -> None:
    boxes = vehicles(0.0)
    with pytest.raises(ValueError, match="other_time must be finite"):
        BEVGlue().align(boxes, boxes, 0.0, math.nan)


def test_refused_alignment_places_no_boxes() -> None:
    with pytest.raises(ValueError, match="no pose: too few"):
        Alignment.refused("too few").boxes_at_ego_instant(vehicles(0.0))


def follow(lists: list[Boxes]) -> tuple[FloatArray, FloatArray]:
    """The last twist of the frame, and the (N, 3) velocities with their variance."""
    noise = TrackNoise()
    tracks, twist = np.zeros(0, TRACK), np.zeros(3)
    variance = np.array([400.0, 400.0, 0.1])
    velocities = np.zeros((0, 3))
    for boxes in lists:
        assert boxes.track_id is not None
        tracks, twist, variance, velocities = track_motion.follow_tracks(  # type: ignore[no-untyped-call]
            tracks, twist, variance, boxes.bev, boxes.track_id, 0.1, noise
        )
    return twist, velocities


def test_frame_motion_and_velocities_over_ground() -> None:
    """Seven of twelve vehicles stand still: what they share is the frame's motion."""
    times = 0.1 * np.arange(20)
    lists = [observed(t, world_SE2_other(t), 1) for t in times]
    twist, velocity = follow(lists)
    np.testing.assert_allclose(twist[:2], [-8.0, 0.0], atol=1.5)
    assert twist[2] == pytest.approx(-0.1, abs=0.05), "what drives pulls a little"
    expected = SPEEDS[:, None] * (world_SE2_other(times[-1]).rotation.T @ [1.0, 0.0])
    np.testing.assert_allclose(velocity[:, :2], expected, atol=2.5)
    assert (velocity[:, 2] < 1.0).all()


def test_new_track_id_begins_at_rest() -> None:
    boxes = vehicles(0.0)
    renamed = boxes.replace(track_id=np.arange(100, 100 + len(boxes)))
    _, velocity = follow([boxes, boxes, renamed])
    np.testing.assert_array_equal(velocity[:, :2], 0.0)
    np.testing.assert_allclose(velocity[:, 2], TrackNoise().speed ** 2)


@pytest.mark.parametrize(
    ("step", "start", "known", "is_vehicle"),
    [
        pytest.param(SE2(0.7, 0.0, 0.01), SE2(), False, True, id="forwards: a sensor on a vehicle"),
        pytest.param(SE2(0.7, 0.05, 0.0), SE2(), False, True, id="a little sideways, as a sensor mounted askew"),
        pytest.param(SE2(0.7, 0.5, 0.0), SE2(), False, False, id="sideways: no vehicle drives so"),
        pytest.param(SE2(-0.7, 0.0, 0.0), SE2(), False, False, id="backwards"),
        pytest.param(SE2(), SE2(), False, False, id="at rest: a map, or a mast"),
        pytest.param(SE2(0.7, 0.0, 0.0), SE2(0.0, 400.0, 0.0), False, False, id="no sensor sees 400 m"),
        pytest.param(SE2(0.7, 0.5, 0.0), SE2(), True, True, id="sideways, but the agent tells its own vehicle"),
    ],
)
def test_vehicle_frames_are_recognised(step: SE2, start: SE2, known: bool, is_vehicle: bool) -> None:
    motion, pose = FrameMotion(), start
    for k in range(40):
        boxes = observed(0.1 * k, pose, 3)
        motion.velocities(box_rows(boxes), track_ids(boxes), 0.1, known)
        pose = pose @ step
    assert motion.is_vehicle is is_vehicle


def test_frame_of_no_vehicle_is_not_extrapolated() -> None:
    """The other's objects are 0.2 s old, but its frame, which slides sideways, is of the ego's instant."""
    glue = BEVGlue()
    for k in range(FRAMES):
        time = 1.0 + 0.1 * k
        world_SE2_other = SE2(5.0 + 0.4 * k, 0.9 * k - 10.0, 0.3)
        alignment = glue.align(observed(time, WORLD_SE2_EGO, 0), observed(time - 0.2, world_SE2_other, 1), time)
    assert alignment.ego_SE2_other is not None
    assert alignment.ego_SE2_other == alignment.ego_SE2_list
    assert alignment.ego_SE2_other.error_to(WORLD_SE2_EGO.inverse() @ world_SE2_other)[0] < 0.5
    assert alignment.time_offset == pytest.approx(-0.2, abs=0.04)


@pytest.mark.parametrize(("detections", "speed"), [(2, 0.0), (3, 35.0), (4, 35.0)])
def test_velocity_takes_three_detections(detections: int, speed: float) -> None:
    """Two detections 3.5 m apart are often two objects under one track id."""
    motion = FrameMotion()
    parked = vehicles(0.0)[SPEEDS == 0.0]
    for k in range(10 + detections):
        fast = Boxes([(3.5 * (k - 10), 6.0, 0.0)], [(4.5, 1.9, 1.6)], [0.0], track_id=[99])
        boxes = Boxes.concatenate([parked, fast]) if k >= 10 else parked
        velocity = motion.velocities(box_rows(boxes), track_ids(boxes), 0.1)
    assert velocity[-1, 0] == pytest.approx(speed, abs=2.0)


def test_rows_in_another_order_change_nothing() -> None:
    lists = [observed(t, world_SE2_other(t), 1) for t in 0.1 * np.arange(8)]
    order = np.random.default_rng(0).permutation(len(SPEEDS))
    twist, velocity = follow(lists)
    shuffled_twist, shuffled = follow([*lists[:-1], lists[-1][order]])
    np.testing.assert_allclose(shuffled_twist, twist, rtol=1e-9)
    np.testing.assert_allclose(shuffled, velocity[order], rtol=1e-9, atol=1e-9)


def test_frame_motion_is_found_again_after_a_turn() -> None:
    """An agent drives straight, turns at 0.5 rad/s and drives straight on, among parked and driving vehicles."""
    motion, pose = FrameMotion(), SE2(-30.0, 0.0, 0.0)
    for k in range(60):
        turn_rate = 0.5 if 20 <= k < 35 else 0.0
        pose = pose @ SE2(0.7, 0.0, 0.1 * turn_rate)
        boxes = observed(0.1 * k, pose, 3)
        velocity = motion.velocities(box_rows(boxes), track_ids(boxes), 0.1)
    np.testing.assert_allclose(motion.twist, [-7.0, 0.0, 0.0], atol=0.5)
    parked = velocity[SPEEDS == 0.0]
    np.testing.assert_allclose(parked, np.tile([-7.0, 0.0], (len(parked), 1)), atol=0.7)


def test_repeated_list_keeps_its_velocities() -> None:
    motion = FrameMotion()
    for k in range(10):
        boxes = observed(0.1 * k, SE2(), 3)
        velocity = motion.velocities(box_rows(boxes), track_ids(boxes), 0.1)
    np.testing.assert_array_equal(motion.velocities(box_rows(boxes), track_ids(boxes), 0.0), velocity)
