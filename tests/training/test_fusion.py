"""Features are kept as they are, and what is trained on them learns, stops and goes on."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch

from cobevglue.boxes import covers_origin
from cobevglue.fusion.cobevglue import MaxFusion
from cobevglue.fusion.f_cooper import FCooper
from cobevglue.perception import PointPillars, PointPillarsConfig
from cobevglue.training import FUSION_PRESETS, FeatureConfig, TrainFusionConfig, load_fusion_config, train_fusion
from cobevglue.training.fusion_features import FusionFrames, write_features
from cobevglue.training.optimisation import OptimisationConfig

SMALL = PointPillarsConfig(
    x_range=(-25.6, 25.6), y_range=(-12.8, 12.8), pillar_channels=16, block_layers=(1, 1, 1), block_channels=(8, 8, 8),
    up_channels=8, shrink_channels=8,
)  # fmt: skip
FRAMES = FeatureConfig(scenarios=2, frames=2, agents=(2, 3))


@pytest.fixture(scope="module")
def detector_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("detector") / "small.safetensors"
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(3)
        PointPillars(SMALL).save(file)
    return file


@pytest.fixture(scope="module")
def features(detector_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("features")
    detector = PointPillars.load(detector_file)
    write_features(folder / "train", FRAMES, detector)
    write_features(folder / "validation", FeatureConfig(split="validation", scenarios=1, frames=1), detector)
    return folder


def config(detector_file: Path, features: Path, **changes: object) -> TrainFusionConfig:
    values = {
        "method": "cobevglue",
        "detector": str(detector_file),
        "features": features,
        "train": FRAMES,
        "validation": FeatureConfig(split="validation", scenarios=1, frames=1),
        "optimisation": OptimisationConfig(epochs=2, samples_per_epoch=8, batch_size=2, mean_decay=0.5),
        "workers": 0,
    }
    return TrainFusionConfig.model_validate({**values, **changes})


def silent(_: str) -> None:
    """Takes lines of progress."""


def test_frames_come_back_as_the_detector_saw_them(detector_file: Path, features: Path) -> None:
    detector = PointPillars.load(detector_file)
    frames = FusionFrames(features / "train")
    assert len(frames) == 4
    assert [len(frames[i].observations) for i in range(4)] == [2, 2, 3, 3]
    frame = frames[2]
    for view in frame.observations:
        with torch.inference_mode():
            maps = detector.multiscale(detector.encode([torch.from_numpy(view.points)]))
        for stored, computed in zip(view.features, maps, strict=True):
            np.testing.assert_allclose(stored.numpy(), computed[0].numpy(), atol=2e-3, rtol=2e-3)
        np.testing.assert_allclose(view.detections.bev, detector.detect(view.points).bev, atol=1e-6)
    assert len(frame.truth) == len(frame.ignored)
    assert not frame.ignored.all()


def test_any_agent_can_be_the_ego(features: Path) -> None:
    frame = FusionFrames(features / "train")[2]
    turned = frame.with_ego(1)
    assert [id(view) for view in turned.observations] == [id(frame.observations[i]) for i in (1, 0, 2)]
    before, after = (
        one.truth.center @ one.world_SE3_agent[0][:3, :3].T + one.world_SE3_agent[0][:3, 3] for one in (frame, turned)
    )
    np.testing.assert_allclose(after, before, atol=1e-6)  # in the world
    assert turned.ignored.sum() >= frame.ignored.sum()
    assert turned.ignored[covers_origin(turned.truth)].all()
    assert turned.early_features is None  # that of the other ego would be wrong


def test_interrupted_features_are_completed_without_repetition(
    detector_file: Path, features: Path, tmp_path: Path
) -> None:
    detector = PointPillars.load(detector_file)
    write_features(tmp_path, FRAMES, detector, silent)
    before = {file.name: file.read_bytes() for file in tmp_path.iterdir()}
    for name in ("index.json", "0001.json", "0001_01.safetensors"):
        (tmp_path / name).unlink()
    kept = (tmp_path / "0000_00.safetensors").stat().st_mtime_ns
    write_features(tmp_path, FRAMES, detector, silent)
    assert {file.name: file.read_bytes() for file in tmp_path.iterdir()} == before
    assert (tmp_path / "0000_00.safetensors").stat().st_mtime_ns == kept


def test_features_of_another_detector_are_refused(features: Path) -> None:
    with pytest.raises(ValueError, match="another detector"):
        write_features(features / "train", FRAMES, PointPillars(SMALL).eval(), silent)


def test_unfinished_features_are_not_opened(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"index\.json"):
        FusionFrames(tmp_path)


def test_training_learns_and_leaves_the_encoder_alone(detector_file: Path, features: Path, tmp_path: Path) -> None:
    long = OptimisationConfig(epochs=4, samples_per_epoch=32, batch_size=4, learning_rate=1e-2, mean_decay=0.5)
    result = train_fusion(config(detector_file, features, optimisation=long), tmp_path, report=silent)
    assert result.finished
    assert set(result.metrics) == {"ap_0.5", "ap_0.7"}
    lines = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    totals = [line["classification"] for line in lines if line["group"] == "epoch"]
    assert totals[-1] < 0.8 * totals[0]
    detector = PointPillars.load(detector_file)
    trained = MaxFusion(detector).load(tmp_path / "last.safetensors")
    assert trained.metadata["training"]["method"] == "cobevglue"
    assert not torch.equal(trained.head.logits.weight, detector.head.logits.weight)
    with pytest.raises(ValueError, match="another encoder"):
        MaxFusion(PointPillars(SMALL)).load(tmp_path / "last.safetensors")
    with pytest.raises(ValueError, match="fusion MaxFusion"):
        FCooper(detector).load(tmp_path / "last.safetensors")


def test_resumed_run_equals_uninterrupted_run(
    detector_file: Path, features: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    settings = config(detector_file, features)
    train_fusion(settings, tmp_path / "whole", report=silent)

    class InterruptError(Exception):
        pass

    def stop_in_second_epoch(text: str) -> None:
        if "epoch 2/2" in text:
            raise InterruptError

    with pytest.raises(InterruptError):
        train_fusion(settings, tmp_path / "parts", report=stop_in_second_epoch)
    train_fusion(settings, tmp_path / "parts", resume=True, report=silent)
    detector = PointPillars.load(detector_file)
    whole, parts = (MaxFusion(detector).load(tmp_path / run / "last.safetensors") for run in ("whole", "parts"))
    for name, value in whole.state_dict().items():
        assert torch.equal(value, parts.state_dict()[name]), name


def test_what_cannot_be_resumed_or_trained_says_why(detector_file: Path, features: Path, tmp_path: Path) -> None:
    settings = config(detector_file, features)
    with pytest.raises(FileNotFoundError, match="no epoch"):
        train_fusion(settings, tmp_path, resume=True)
    train_fusion(settings, tmp_path, report=silent)
    with pytest.raises(ValueError, match="has a run already"):
        train_fusion(settings, tmp_path, report=silent)
    with pytest.raises(ValueError, match="other settings: seed"):
        train_fusion(config(detector_file, features, seed=5), tmp_path, resume=True, report=silent)
    with pytest.raises(ValueError, match="'late' has nothing to train"):
        train_fusion(config(detector_file, features, method="late"), tmp_path / "late", report=silent)
    with pytest.raises(ValueError, match="did you mean 'coalign'"):
        load_fusion_config("coalgin")
    assert load_fusion_config("cobevglue", ["optimisation.epochs=7"]).optimisation.epochs == 7
    assert all(preset.method == name for name, preset in FUSION_PRESETS.items())
