"""Episodes of a data set."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from cobevglue import Boxes
from cobevglue.datasets import AgentFrame, Dataset, Frame, Scenario
from cobevglue.training import DatasetEpisodes
from cobevglue.training.config import DataConfig
from cobevglue.training.sources import make_source


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


def test_pass_covers_every_frame_and_agent_once() -> None:
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


def test_reader_options_are_refused_for_simulated_data() -> None:
    with pytest.raises(ValueError, match=r"data\.reader: has no effect on simulated data"):
        make_source(DataConfig(reader={"labels": "original"}), 0, validation=False)


def test_clouds_without_labels_are_left_out_with_warning() -> None:
    class Incomplete(Numbered):
        def _agents(self, number: int) -> dict[str, AgentFrame]:
            def missing() -> tuple[np.ndarray, Boxes]:
                raise FileNotFoundError("labels.json is not there")

            agents = super()._agents(number)
            return {**agents, "b": AgentFrame(missing, lambda: np.zeros((1, 4), dtype=np.float32))}

    with pytest.warns(UserWarning, match="a cloud without labels is left out: labels.json is not there"):
        samples = DatasetEpisodes(Incomplete(), frames_per_episode=1).episode(0)
    assert len(samples) == 1
