"""Equation (1a): points in, features and tracked boxes out."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from cobevglue.perception import Perception, PointPillars

from .conftest import OBJECTS, cloud_of


def test_objects_keep_their_identity_over_frames(trained: PointPillars) -> None:
    perception = Perception(trained, min_track_score=0.5)
    ids = []
    for frame in range(4):
        cloud = cloud_of(OBJECTS)
        cloud[:, 0] += 0.01 * frame  # the network knows one cloud by heart; farther off, scores depend on the CPU
        out = perception.step(cloud, time=0.1 * frame)
        order = np.lexsort(np.round(out.boxes.center[:, :2]).T)
        assert out.boxes.track_id is not None
        ids.append(out.boxes.track_id[order].tolist())
    assert ids == [ids[0]] * 4
    assert len(set(ids[0])) == 4


def test_outputs_have_consistent_lengths(trained: PointPillars) -> None:
    out = Perception(trained).step(cloud_of(OBJECTS))
    assert [tuple(f.shape) for f in out.features] == [(12, 24, 32), (16, 12, 16), (24, 6, 8)]
    assert out.variance.shape == (len(out.boxes), 3)
    assert list(out.seconds) == ["pillars", "backbone", "head", "boxes", "heading", "tracking"]
    assert out.boxes.score is not None
    assert out.detections.score is not None
    assert out.detections.track_id is None
    assert out.boxes.score.tolist() == [s for s in out.detections.score if s >= 0.25]


def test_tracked_heading_is_stable(trained: PointPillars) -> None:
    """The head is made to mix up front and back in one frame of four; all that is told stays as it was."""

    def mix_up() -> None:
        with torch.no_grad():
            for values in trained.head.direction.parameters():
                values.mul_(-1.0)

    perception = Perception(trained, min_track_score=0.5)
    seen = []
    for frame in range(4):
        if frame == 2:
            mix_up()
        out = perception.step(cloud_of(OBJECTS))
        if frame == 2:
            mix_up()
        assert len(out.boxes) == 4
        np.testing.assert_array_equal(out.detections.yaw[: len(out.boxes)], out.boxes.yaw)
        seen.append(out.boxes.yaw[np.lexsort(np.round(out.boxes.center[:, :2]).T)])
    for yaw in seen[1:]:
        np.testing.assert_allclose(np.cos(yaw - seen[0]), 1.0, atol=1e-3)


def test_after_a_reset_time_and_tracks_start_again(trained: PointPillars) -> None:
    perception = Perception(trained)
    perception.step(cloud_of(OBJECTS), time=5.0)
    with pytest.raises(ValueError, match="time"):
        perception.step(cloud_of(OBJECTS), time=1.0)
    perception.reset()
    perception.step(cloud_of(OBJECTS), time=1.0)


@pytest.mark.parametrize(
    ("point", "why"),
    [
        ([0.0, 0.0, 0.0, 0.0], "a pulse without a return, as several drivers report it"),
        ([0.0, 0.0, 0.0, 0.7], "the same with an intensity"),
        ([np.nan, 1.0, 0.0, 0.0], "no x"),
        ([1.0, 1.0, np.inf, 0.0], "no z"),
    ],
)
def test_invalid_points_are_counted(trained: PointPillars, point: list[float], why: str) -> None:
    cloud = cloud_of(OBJECTS)
    expected = Perception(trained).step(cloud)
    out = Perception(trained).step(np.concatenate([cloud, np.tile(np.array(point, np.float32), (500, 1))]))
    assert (expected.dropped_points, out.dropped_points) == (0, 500), why
    np.testing.assert_array_equal(out.points, expected.points, why)
    np.testing.assert_array_equal(out.detections.bev, expected.detections.bev, why)


def test_cloud_without_intensity_keeps_all_points(trained: PointPillars) -> None:
    cloud = cloud_of(OBJECTS)
    expected = Perception(trained).step(cloud)
    cloud[:, 3] = np.nan
    out = Perception(trained).step(cloud)
    assert len(out.boxes) == len(expected.boxes) > 0
    assert out.dropped_points == 0
    np.testing.assert_array_equal(out.detections.bev, expected.detections.bev)


def test_an_empty_frame_is_a_frame(trained: PointPillars) -> None:
    out = Perception(trained, min_track_score=0.5).step(np.zeros((0, 4)))
    assert len(out.boxes) == 0
    assert out.boxes.track_id is not None


@pytest.mark.parametrize("score", [-0.1, 1.1, float("nan")])
def test_a_threshold_is_a_score(trained: PointPillars, score: float) -> None:
    with pytest.raises(ValueError, match="min_track_score"):
        Perception(trained, min_track_score=score)
