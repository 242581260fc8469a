"""Samples: points in boxes, and episodes of a data set."""

from __future__ import annotations

import math
import pickle
from pathlib import Path

import numpy as np
import pytest

from cobevglue import Boxes
from cobevglue.datasets import AgentFrame, Dataset, Frame, Scenario
from cobevglue.training import DatasetEpisodes, Sample, count_points


@pytest.mark.parametrize(
    ("point", "size", "yaw", "count"),
    [
        ((10.0, 0.0, 0.0), (4, 2, 1.5), 0.0, 1),  # the centre
        ((12.0, 1.0, 0.75), (4, 2, 1.5), 0.0, 1),  # a corner belongs to the box
        ((12.1, 0.0, 0.0), (4, 2, 1.5), 0.0, 0),  # ahead of it
        ((10.0, 1.1, 0.0), (4, 2, 1.5), 0.0, 0),  # beside it
        ((10.0, 0.0, 0.8), (4, 2, 1.5), 0.0, 0),  # above it
        ((10.0, 1.9, 0.0), (4, 2, 1.5), math.pi / 2, 1),  # beside it, but it stands across
        ((11.9, 0.0, 0.0), (4, 2, 1.5), math.pi / 2, 0),  # ahead of it, but it stands across
        ((10.0, 0.0, 9.0), (4, 2, 0), 0.0, 1),  # a box of unknown height is as high as you like
    ],
)
def test_points_in_a_box(
    point: tuple[float, float, float], size: tuple[float, float, float], yaw: float, count: int
) -> None:
    points = np.array([[-50, 0, 0, 0], [*point, 0.5], [50, 0, 0, 0]], dtype=np.float32)
    assert count_points(points, Boxes([(10, 0, 0)], [size], [yaw])).tolist() == [count]


def test_no_points_and_no_boxes() -> None:
    nothing = np.zeros((0, 4), dtype=np.float32)
    assert count_points(nothing, Boxes([(0, 0, 0)], [(4, 2, 1)], [0])).tolist() == [0]
    assert count_points(nothing, Boxes.empty()).shape == (0,)


def test_a_sample_refuses_what_does_not_fit() -> None:
    with pytest.raises(ValueError, match="points must have shape"):
        Sample(np.zeros((3, 3), dtype=np.float32), Boxes.empty(), np.zeros(0, dtype=np.int64))
    with pytest.raises(ValueError, match="point_count must have shape"):
        Sample(np.zeros((3, 4), dtype=np.float32), Boxes.empty(), np.zeros(1, dtype=np.int64))


class Numbered(Dataset):
    """Drives of 4 and 3 frames with two agents, whose clouds are one point with the frame's number, and a blind one."""

    def __init__(self, root: str | Path = "", split: str = "") -> None:
        self.scenarios = ("long", "short")

    def _scenario(self, name: str) -> Scenario:
        first, count = (0, 4) if name == "long" else (4, 3)
        return Scenario(name, count, lambda i: Frame(name, str(i), 0.1 * i, self._agents(first + i)))

    def _agents(self, number: int) -> dict[str, AgentFrame]:
        def labels() -> tuple[np.ndarray, Boxes]:
            return np.eye(4), Boxes([(number, 0, 0)], [(4, 2, 1)], [0])

        def points() -> np.ndarray:
            return np.array([[number, 0, 0, 0]], dtype=np.float32)

        return {
            "a": AgentFrame(labels, points),
            "b": AgentFrame(labels, points),
            "blind": AgentFrame(labels, lambda: None),
        }


def test_a_pass_has_every_frame_once_with_all_agents_that_have_a_cloud() -> None:
    source = DatasetEpisodes(Numbered(), frames_per_episode=1)
    assert len(source) == 7
    episodes = [source.episode(i) for i in range(7)]
    assert all(len(samples) == 2 for samples in episodes)
    assert sorted(int(samples[0].points[0, 0]) for samples in episodes) == list(range(7))
    assert all(sample.point_count.tolist() == [1] for samples in episodes for sample in samples)


def test_the_next_pass_has_another_order() -> None:
    source = DatasetEpisodes(Numbered(), frames_per_episode=1)
    first, second = ([int(source.episode(7 * k + i)[0].points[0, 0]) for i in range(7)] for k in range(2))
    assert sorted(second) == sorted(first)
    assert second != first


def test_an_episode_depends_on_seed_and_index_alone() -> None:
    source, copy = DatasetEpisodes(Numbered(), seed=3), pickle.loads(pickle.dumps(DatasetEpisodes(Numbered(), seed=3)))
    source.episode(9)  # what was asked for before plays no part
    for a, b in zip(source.episode(1), copy.episode(1), strict=True):
        np.testing.assert_array_equal(a.points, b.points)
