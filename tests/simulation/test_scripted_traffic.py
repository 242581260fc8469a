"""Paths, motions and placement of scripted vehicles."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.integrate import cumulative_trapezoid, quad
from shapely.geometry import Polygon

from cobevglue.simulation.scripted_traffic import (
    LIDAR_HEIGHT,
    Cruise,
    Departure,
    Motion,
    Path,
    Placement,
    Traffic,
    Vehicle,
    random_kind,
    stationary,
)

EAST = Path((0.0, 0.0, 0.0), ((10.0, 0.0),))


@pytest.mark.parametrize(
    ("path", "travelled", "expected", "why"),
    [
        (EAST, 7.0, (7, 0, 0), "straight on"),
        (EAST, -7.0, (-7, 0, 0), "the first segment extends backwards"),
        (EAST, 70.0, (70, 0, 0), "the last segment extends forwards"),
        (Path((1, 2, math.pi / 2), ((5, 0.0),)), 5.0, (1, 7, 90), "a start to the north"),
        (Path((0, 0, 0), ((20, 0.1),)), 5 * math.pi, (10, 10, 90), "a quarter circle of 10 m to the left"),
        (Path((0, 0, 0), ((20, -0.1),)), 5 * math.pi, (10, -10, -90), "and to the right"),
        (Path((0, 0, 0), ((4, 0), (5 * math.pi, 0.1), (9, 0))), 4 + 5 * math.pi + 3, (14, 13, 90), "line, arc, line"),
    ],
)
def test_pose_along_a_path(path: Path, travelled: float, expected: tuple[float, ...], why: str) -> None:
    x, y, yaw = path.at(np.array([travelled]))[0]
    np.testing.assert_allclose((x, y, math.degrees(yaw)), expected, atol=1e-9, err_msg=why)


@given(st.lists(st.tuples(st.floats(8, 30), st.floats(-0.1, 0.1)), min_size=1, max_size=5), st.floats(0.5, 6.0))
def test_smoothed_path_is_integral_of_its_curvature(segments: list[tuple[float, float]], transition: float) -> None:
    sharp = Path((3.0, -2.0, 0.7), tuple(segments))
    path = sharp.smoothed(transition)
    total = sum(length for length, _ in segments)
    assert sum(length for length, _ in path.segments) == pytest.approx(total)
    assert path.at(np.array([total]))[0, 2] == pytest.approx(sharp.at(np.array([total]))[0, 2]), "the turn is the same"
    s = np.linspace(0.0, total, 4001)
    poses = path.at(s)
    x = 3.0 + cumulative_trapezoid(np.cos(poses[:, 2]), s, initial=0.0)
    y = -2.0 + cumulative_trapezoid(np.sin(poses[:, 2]), s, initial=0.0)
    np.testing.assert_allclose(poses[:, :2], np.column_stack([x, y]), atol=1e-4)


def test_smoothed_path_turns_gradually() -> None:
    path = Path((0.0, 0.0, 0.0), ((20.0, 0.0), (20.0, 0.1), (20.0, 0.0)))
    s = np.arange(0.0, 60.0, 0.1)
    most = [np.abs(np.diff(p.at(s)[:, 2], 2)).max() / 0.1**2 for p in (path, path.smoothed(8.0))]
    assert most[0] > 0.9, "a change of curvature of 0.1 in 0.1 m"
    assert most[1] < 0.2, "one eighth of it within 1 m"


def test_short_segment_cannot_be_smoothed() -> None:
    with pytest.raises(ValueError, match=r"segment 1 is 2.00 m long, too short for transitions of 3.0 m"):
        Path((0.0, 0.0, 0.0), ((20.0, 0.0), (2.0, 0.1), (20.0, 0.0))).smoothed(3.0)


@pytest.mark.parametrize(
    ("motion", "speed"),
    [
        (Cruise(5.0, 10.0, 0.3, 8.0, 1.0), lambda t: 10.0 * (1.0 + 0.3 * math.cos(2.0 * math.pi / 8.0 * t + 1.0))),
        (
            Departure(5.0, 2.0, 9.0, 4.0),
            lambda t: 9.0 * (3 * u**2 - 2 * u**3 if (u := (t - 2) / 4) < 1 else 1) * (t > 2),
        ),
    ],
)
def test_travelled_is_integral_of_speed(motion: Motion, speed: object) -> None:
    for time in (0.0, 1.0, 3.0, 7.0, 12.0):
        expected, _ = quad(speed, 0.0, time, points=[2.0, 6.0], limit=200)
        assert motion.travelled(np.array([time]))[0] == pytest.approx(5.0 + expected, abs=1e-6)


def test_vehicle_without_speed_stays() -> None:
    poses = Vehicle("car", (4.5, 1.9, 1.5), EAST, Cruise(50.0, 0.0, 0.3)).pose(np.array([0.0, 5.0, 50.0]))
    assert (poses == poses[0]).all()


def test_follower_repeats_leader_a_reaction_time_later() -> None:
    reaction, rate = 1.5, 2.0 * math.pi / 9.0
    leader, follower = Cruise(0.0, 30.0, 0.05, 9.0, 0.4), Cruise(-40.0, 30.0, 0.05, 9.0, 0.4 - rate * reaction)
    time = np.linspace(2.0, 10.0, 50)
    steps = [np.diff(motion.travelled(at)) for motion, at in ((leader, time - reaction), (follower, time))]
    np.testing.assert_allclose(steps[1], steps[0], atol=1e-9)


def test_traffic_has_boxes_on_the_ground() -> None:
    parked, moving = (
        stationary("van", (5.0, 2.0, 2.2), 3.0, 4.0, 0.5),
        Vehicle("car", (4.5, 1.9, 1.5), EAST, Cruise(0.0, 10.0)),
    )
    boxes = Traffic((parked, moving)).at(2.0)
    np.testing.assert_allclose(boxes.bev, [(3.0, 4.0, 5.0, 2.0, 0.5), (20.0, 0.0, 4.5, 1.9, 0.0)])
    np.testing.assert_allclose(boxes.center[:, 2] - boxes.size[:, 2] / 2, -LIDAR_HEIGHT)
    assert boxes.track_id is not None
    assert boxes.label is not None
    assert (boxes.track_id.tolist(), boxes.label.tolist()) == ([0, 1], ["van", "car"])


@given(st.floats(3.0, 17.0), st.floats(3.0, 17.0), st.floats(-12, 12), st.floats(-5, 5), st.floats(-3.0, 3.0))
def test_placed_vehicles_do_not_overlap(long: float, other: float, x: float, y: float, yaw: float) -> None:
    a, b = stationary("car", (long, 2.0, 1.5), 0.0, 0.0, 0.0), stationary("car", (other, 2.5, 1.5), x, y, yaw)
    placement = Placement(1.0)
    assert placement.add(a)
    first, second = (Polygon(corners) for corners in Traffic((a, b)).at(0.0).bev_corners())
    if placement.add(b):
        assert not first.intersects(second)
    else:
        assert first.distance(second) < 2.5, "only what is near is refused"
        assert placement.vehicles == [a]


def test_crossing_vehicles_touch_at_any_time() -> None:
    placement = Placement(10.0)
    north = Path((0.0, -50.0, math.pi / 2), ((1.0, 0.0),))
    assert placement.add(Vehicle("car", (4.5, 1.9, 1.5), EAST, Cruise(-50.0, 10.0)))
    assert not placement.add(Vehicle("car", (4.5, 1.9, 1.5), north, Cruise(0.0, 10.0))), "both at the origin at 5 s"
    assert placement.add(Vehicle("car", (4.5, 1.9, 1.5), north, Cruise(-10.0, 10.0))), "a second later"


def test_random_kinds_follow_their_shares() -> None:
    rng = np.random.default_rng(0)
    drawn = [random_kind(rng, {"car": 3.0, "semitrailer": 1.0}) for _ in range(400)]
    assert sum(label == "truck" for label, _ in drawn) == pytest.approx(100, abs=30)
    assert all(size[0] > 15.0 for label, size in drawn if label == "truck")
    assert all(3.8 < size[0] < 5.2 and 1.6 < size[1] < 2.1 for label, size in drawn if label == "car")
