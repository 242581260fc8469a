"""The weights that come with the package: they load, say where they are from, and find vehicles they never saw."""

from __future__ import annotations

from pathlib import Path

import pytest

from cobevglue import BEVGlue
from cobevglue.datasets import OPV2V, Scenario
from cobevglue.evaluation.alignment import evaluate
from cobevglue.evaluation.alignment_data import perceived_sequences
from cobevglue.evaluation.detection import evaluate_detections
from cobevglue.evaluation.detection_data import dataset_clouds, detect, simulated_clouds
from cobevglue.perception import CONFIGS, Perception, PointPillars
from cobevglue.simulation.episodes import EpisodeSettings, SimulatedEpisodes

RANGE = (-70.0, 70.0, -39.0, 39.0)
FRAMES = 6
"""Frames of the real drive that are looked at; the first has no cloud."""


@pytest.fixture(scope="module", params=sorted(CONFIGS))
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture(scope="module")
def detector(name: str) -> PointPillars:
    return PointPillars.pretrained(name)


@pytest.fixture(scope="module")
def drive(culver_city: Path) -> Scenario:
    scenario = OPV2V(culver_city, "test_culvercity")["TwoCars_1"]
    return Scenario(scenario.name, FRAMES, lambda index: scenario[index])


def test_weights_match_their_configuration(name: str, detector: PointPillars) -> None:
    assert detector.config == CONFIGS[name]
    assert not detector.training


def test_they_say_how_they_came_about(detector: PointPillars) -> None:
    *stages, last = detector.metadata["stages"]
    assert "train heading" in last["command"]
    assert all("train detector" in stage["command"] for stage in stages)
    for stage in (*stages, last):
        assert stage["commit"]
        assert stage["training"]["data"]["source"] == "simulated"
        assert stage["training"]["data"]["split"] == "train"


def test_another_name_is_an_error_with_the_nearest() -> None:
    with pytest.raises(ValueError, match=r"'compakt'.*'compact'"):
        PointPillars.pretrained("compakt")


def test_weights_detect_on_unseen_network(detector: PointPillars) -> None:
    """Bounds are far below what benchmarks/perception.py measures: this is to see that nothing is broken."""
    source = SimulatedEpisodes("test", 0, EpisodeSettings(snapshots=1, agents=4))
    report = evaluate_detections(
        [detect(cloud, detector) for cloud in simulated_clouds(source, 4)], evaluation_range=RANGE, min_points=5
    )
    assert report.overall.truth > 20
    assert report.ap(0.5) > 0.75


def test_they_find_vehicles_in_opv2vs_clouds(detector: PointPillars, drive: Scenario) -> None:
    clouds = [cloud for cloud in dataset_clouds([drive]) if cloud.points is not None]
    report = evaluate_detections([detect(cloud, detector) for cloud in clouds], evaluation_range=RANGE)
    assert report.overall.truth > 100
    assert report.ap(0.5) > 0.8


def test_two_agents_find_each_other_by_their_detections(detector: PointPillars, drive: Scenario) -> None:
    """The paper's hypothesis: what two real agents detect tells where they stand. Refused or right, never wrong."""
    (sequence,) = perceived_sequences([drive], lambda: Perception(detector))
    records = list(evaluate([sequence], BEVGlue))
    assert len(records) >= FRAMES - 2
    assert sum(record.accepted for record in records) >= len(records) - 1
    for record in records:
        assert not record.accepted or (record.translation_error < 1.5 and record.yaw_error < 0.05)
