"""Heading refinement is trained on what the detector finds, and nothing else of the detector changes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from cobevglue.perception import PointPillars
from cobevglue.perception.heading import HeadingInputs, heading_inputs
from cobevglue.simulation.episodes import EpisodeSettings, SimulatedEpisodes
from cobevglue.training import OptimisationConfig, TrainHeadingConfig, load_heading_config, train_heading
from cobevglue.training.config import DataConfig
from cobevglue.training.heading import HeadingAugmentation, augmented
from cobevglue.training.heading_examples import examples_in

DATA = DataConfig(min_points=2, options={"snapshots": 1, "agents": 2})


@pytest.fixture(scope="module")
def examples(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("examples")


def config(examples: Path, **changes: object) -> TrainHeadingConfig:
    values = {
        "data": DATA,
        "episodes": 2,
        "validation_episodes": 1,
        "examples": examples,
        "optimisation": OptimisationConfig(epochs=2, samples_per_epoch=64, batch_size=16, mean_decay=0.5),
        "threads": 1,
    }
    return TrainHeadingConfig.model_validate({**values, **changes})


def silent(_: str) -> None:
    """Takes lines of progress."""


def test_an_example_is_a_vehicle_that_was_found() -> None:
    detector = PointPillars.pretrained("compact")
    cloud = SimulatedEpisodes("validation", 3, EpisodeSettings(snapshots=1, agents=1)).episode(0)[0]
    examples = examples_in(cloud, detector, min_points=2)
    detector.detection = detector.detection.model_copy(update={"heading_refinement": False})
    boxes = detector.detect(cloud.points)
    assert 0 < len(examples.correct) <= len(boxes)
    for vehicle, correct, number in zip(examples.inputs.vehicle, examples.correct, examples.inputs.number, strict=True):
        nearest = np.hypot(*(cloud.boxes.center[:, :2] - vehicle[:2].numpy()).T).argmin()
        assert (np.cos(cloud.boxes.yaw[nearest] - float(vehicle[6])) > 0) == bool(correct)
        assert cloud.point_count[nearest] >= 2
        assert number >= 1
    everything = examples_in(cloud, detector, min_points=10_000_000)
    assert len(everything.correct) == 0


def test_training_changes_the_heading_refiner_alone(examples: Path, tmp_path: Path) -> None:
    result = train_heading(config(examples), tmp_path, report=silent)
    assert result.finished
    assert set(result.metrics) == {"loss", "flipped", "flipped_before"}
    before, after = PointPillars.pretrained("compact"), PointPillars.load(tmp_path / "last.safetensors")
    theirs = after.state_dict()
    changed = {
        name.split(".")[0] for name, value in before.state_dict().items() if not torch.equal(value, theirs[name])
    }
    assert changed == {"heading_refiner"}
    assert after.metadata["training"]["episodes"] == 2
    assert after.metadata["metrics"] == result.metrics
    detectors = [stage for stage in before.metadata["stages"] if "train detector" in stage["command"]]
    assert after.metadata["stages"] == detectors  # an earlier heading refinement is not among what this one is made of
    totals = [json.loads(line)["total"] for line in (tmp_path / "log.jsonl").read_text().splitlines()[:-1]]
    assert len(totals) == 2


def test_it_may_start_from_another_detectors_refiner(examples: Path, tmp_path: Path) -> None:
    """At a learning rate of next to nothing it ends where it started."""
    slow = OptimisationConfig(epochs=1, samples_per_epoch=16, batch_size=16, learning_rate=1e-12, weight_decay=0.0)
    train_heading(config(examples, optimisation=slow, init_from="compact"), tmp_path, report=silent)
    theirs = PointPillars.pretrained("compact").heading_refiner.state_dict()
    for name, value in PointPillars.load(tmp_path / "last.safetensors").heading_refiner.state_dict().items():
        assert torch.allclose(value, theirs[name], atol=1e-8)


def test_resumed_run_equals_uninterrupted_run(examples: Path, tmp_path: Path) -> None:
    train_heading(config(examples), tmp_path / "whole", report=silent)

    def interrupt(line: str) -> None:
        if line.startswith("epoch 2"):
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        train_heading(config(examples), tmp_path / "halves", report=interrupt)
    with pytest.raises(ValueError, match="has a run already"):
        train_heading(config(examples), tmp_path / "halves", report=silent)
    with pytest.raises(ValueError, match="other settings: seed"):
        train_heading(config(examples, seed=3), tmp_path / "halves", resume=True, report=silent)
    train_heading(config(examples), tmp_path / "halves", resume=True, report=silent)
    whole, halves = (PointPillars.load(tmp_path / name / "last.safetensors") for name in ("whole", "halves"))
    for one, other in zip(whole.heading_refiner.parameters(), halves.heading_refiner.parameters(), strict=True):
        assert torch.equal(one, other)


def test_examples_are_made_once_and_of_one_kind(examples: Path, tmp_path: Path) -> None:
    train_heading(config(examples), tmp_path / "one", report=silent)
    made = {file: file.stat().st_mtime_ns for file in examples.rglob("*")}
    assert len([file for file in made if file.suffix == ".safetensors"]) == 3
    train_heading(config(examples), tmp_path / "two", report=silent)
    assert {file: file.stat().st_mtime_ns for file in examples.rglob("*")} == made
    with pytest.raises(ValueError, match="other settings"):
        train_heading(config(examples, episodes=3), tmp_path / "three", report=silent)


def test_detector_without_detections_gives_no_examples(tmp_path: Path) -> None:
    blind = PointPillars.pretrained("compact")
    assert blind.head.logits.bias is not None
    with torch.no_grad():
        blind.head.logits.bias.fill_(-50.0)
    blind.save(tmp_path / "blind.safetensors")
    changed = config(tmp_path / "examples", detector=str(tmp_path / "blind.safetensors"), episodes=1)
    with pytest.raises(ValueError, match="found none"):
        train_heading(changed, tmp_path / "run", report=silent)


def test_an_unknown_preset_names_the_nearest() -> None:
    with pytest.raises(ValueError, match="did you mean 'compact'"):
        load_heading_config("compakt")


def test_a_look_is_stored_to_the_millimetre() -> None:
    """Half precision is enough for points within a vehicle's reach."""
    detector = PointPillars.pretrained("compact")
    cloud = SimulatedEpisodes("validation", 3, EpisodeSettings(snapshots=1, agents=1)).episode(0)[0]
    with torch.inference_mode():
        (found,) = detector.boxes(detector([torch.from_numpy(cloud.points)]))
    exact = heading_inputs(cloud.points, found).points
    assert (exact.half().float() - exact).abs().max() < 5e-3


def test_augmentation_drops_and_jitters_within_limits() -> None:
    """On 400 vehicles with 10 to 100 points each at (1, 2, 3), with two others around each."""
    k = 400
    number = torch.linspace(10, 100, k).long()
    points = torch.where(torch.arange(64)[None, :, None] < number[:, None, None], torch.tensor([1.0, 2.0, 3.0]), 0.0)
    vehicle, around = torch.full((k, 9), 0.5), torch.full((k, 8, 6), 0.5)
    inputs = HeadingInputs(points, number, vehicle, around)
    random = torch.Generator().manual_seed(0)

    nothing = HeadingAugmentation(thinning=0.0, jitter=0.0, stretch=0.0, alone=0.0, unsure=0.0)
    for before, after in zip(inputs, augmented(inputs, nothing, random), strict=True):
        assert torch.equal(before, after)

    some = HeadingAugmentation(thinning=0.5, jitter=0.01, stretch=0.1, alone=0.25, unsure=0.25)
    other = augmented(inputs, some, random)
    share = other.number / number
    assert share.min() >= 0.5
    assert share.max() <= 1.1
    assert 0.7 < share.mean() < 0.85
    there = torch.arange(64) < other.number[:, None]
    stretched = other.points[there] / torch.tensor([1.0, 2.0, 3.0])
    assert stretched.min() > 0.9 - 0.05
    assert stretched.max() < 1.1 + 0.05
    hidden = (other.around == 0).all(dim=(1, 2))
    assert 0.15 < hidden.float().mean() < 0.35
    assert torch.equal(other.around[~hidden], around[~hidden])
    assert 0.15 < (other.vehicle[:, 8] == 0).float().mean() < 0.35
    assert torch.equal(other.vehicle[:, :8], vehicle[:, :8])
