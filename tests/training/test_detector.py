"""The training loop: it learns, and a run that was interrupted is no different from one that was not."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import torch

from cobevglue.datasets.labelled_cloud import LabelledCloud
from cobevglue.perception import PointPillars
from cobevglue.training import TrainDetectorConfig, TrainingResult, train_detector
from cobevglue.training.checkpoint import load_state

from .boxes_on_a_plane import BoxesOnAPlane

SOURCE, VALIDATION = BoxesOnAPlane(seed=0), BoxesOnAPlane(seed=1)


def run(config: TrainDetectorConfig, folder: Path, **options: Any) -> TrainingResult:
    given = {"source": SOURCE, "validation_source": VALIDATION, "report": lambda text: None, **options}
    return train_detector(config, folder, **given)


def changed(config: TrainDetectorConfig, **changes: dict[str, Any]) -> TrainDetectorConfig:
    values = config.model_dump()
    for name, change in changes.items():
        values[name] |= change
    return TrainDetectorConfig.model_validate(values)


def weights(folder: Path, name: str = "last") -> dict[str, torch.Tensor]:
    return dict(PointPillars.load(folder / f"{name}.safetensors").state_dict())


def assert_equal(one: dict[str, torch.Tensor], other: dict[str, torch.Tensor]) -> None:
    assert one.keys() == other.keys()
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_it_learns(config: TrainDetectorConfig, tmp_path: Path) -> None:
    optimisation = {"epochs": 3, "samples_per_epoch": 40, "learning_rate": 1e-2}
    run(changed(config, optimisation=optimisation, validation={"episodes": 0}), tmp_path)
    entries = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    # Not the validation's: in sixty steps the norms' statistics are still far behind the weights.
    losses = [entry["total"] for entry in entries if entry["group"] == "epoch"]
    assert len(losses) == 3
    assert losses[-1] < 0.7 * losses[0]


@pytest.mark.parametrize("workers", [0, 1])
def test_a_resumed_run_ends_with_the_same_bits(config: TrainDetectorConfig, tmp_path: Path, workers: int) -> None:
    # Three batches an epoch, an odd number; three epochs, of which the second is entered anew.
    config = changed(config, optimisation={"epochs": 3, "samples_per_epoch": 6}, data={"workers": workers, "pool": 2})
    straight = run(config, tmp_path / "straight")
    stopped = run(config, tmp_path / "resumed", max_minutes=0.0)
    resumed = run(config, tmp_path / "resumed", resume=True)
    assert (stopped.epochs, stopped.finished) == (1, False)
    assert (resumed.epochs, resumed.finished) == (3, True)
    assert resumed.metrics == straight.metrics
    assert_equal(weights(tmp_path / "straight"), weights(tmp_path / "resumed"))
    one, other = (load_state(tmp_path / name / "state.pt", torch.device("cpu")) for name in ("straight", "resumed"))
    assert_equal(one.model, other.model)
    for row, moments in one.optimizer["state"].items():
        assert_equal(moments, other.optimizer["state"][row])


@dataclass(frozen=True)
class Interrupted:
    """A source at which somebody presses Ctrl-C in the second epoch."""

    first_of_second: int = 8

    def episode(self, index: int) -> Sequence[LabelledCloud]:
        if index >= self.first_of_second:
            raise KeyboardInterrupt
        return SOURCE.episode(index)


def test_an_interrupted_run_keeps_its_last_epoch(config: TrainDetectorConfig, tmp_path: Path) -> None:
    straight = run(config, tmp_path / "straight")
    with pytest.raises(KeyboardInterrupt):
        run(config, tmp_path / "run", source=Interrupted())
    assert run(config, tmp_path / "run", resume=True).metrics == straight.metrics
    assert_equal(weights(tmp_path / "straight"), weights(tmp_path / "run"))


def test_files_say_what_they_are(config: TrainDetectorConfig, tmp_path: Path) -> None:
    result = run(config, tmp_path)
    metadata = PointPillars.load(tmp_path / "last.safetensors").metadata
    assert metadata["training"] == config.model_dump(mode="json")
    assert metadata["epoch"] == 2
    assert metadata["metrics"].keys() == result.metrics.keys() >= {"total", "ap_0.5", "ap_0.7"}
    assert list(tmp_path.glob("events.out.tfevents.*"))
    entries = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert {"step", "learning_rate", "samples_per_second"} <= entries[0].keys()
    assert weights(tmp_path, "best").keys() == weights(tmp_path).keys()


def test_resumed_log_has_each_epoch_once(config: TrainDetectorConfig, tmp_path: Path) -> None:
    run(config, tmp_path, max_minutes=0.0)
    with (tmp_path / "log.jsonl").open("a") as log:
        log.write('{"group": "train", "step": 5, "epoch": 1}\n{"group": "tr')  # of the epoch that was lost
    run(config, tmp_path, resume=True)
    entries = [json.loads(line) for line in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [entry["step"] for entry in entries if entry["group"] == "epoch"] == [4, 8]
    assert [entry["step"] for entry in entries] == sorted(entry["step"] for entry in entries)


def test_a_folder_with_a_run_is_not_overwritten(config: TrainDetectorConfig, tmp_path: Path) -> None:
    run(config, tmp_path)
    with pytest.raises(ValueError, match="has a run already; resume it"):
        run(config, tmp_path)


def test_nothing_to_resume_is_an_error(config: TrainDetectorConfig, tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="no epoch of this run was completed"):
        run(config, tmp_path, resume=True)


def test_resuming_with_other_settings_names_them(config: TrainDetectorConfig, tmp_path: Path) -> None:
    run(config, tmp_path, max_minutes=0.0)
    other = changed(config, optimisation={"clip": 1.0}, data={"pool": 3})
    with pytest.raises(ValueError, match=r"other settings: data\.pool, optimisation\.clip$"):
        run(other, tmp_path, resume=True)
    run(config.model_copy(update={"report_every": 99.0}), tmp_path, resume=True)  # this may change


def test_new_run_starts_from_given_weights(config: TrainDetectorConfig, tmp_path: Path) -> None:
    run(config, tmp_path / "first")
    slow = changed(config, optimisation={"learning_rate": 1e-9, "epochs": 1, "weight_decay": 0.0})
    run(slow.model_copy(update={"init_from": tmp_path / "first" / "last.safetensors"}), tmp_path / "second")
    first, second = weights(tmp_path / "first"), weights(tmp_path / "second")
    names = [name for name in first if name.endswith("weight")]
    assert all(torch.allclose(first[name], second[name], atol=1e-6) for name in names)


def test_weights_of_another_network_are_refused(config: TrainDetectorConfig, tmp_path: Path) -> None:
    run(config, tmp_path / "first")
    other = changed(config, model={"shrink_channels": 8})
    with pytest.raises(ValueError, match="weights of another network"):
        run(other.model_copy(update={"init_from": tmp_path / "first" / "last.safetensors"}), tmp_path / "second")


def test_without_validation_the_last_weights_are_there(config: TrainDetectorConfig, tmp_path: Path) -> None:
    result = run(changed(config, validation={"episodes": 0}), tmp_path)
    assert (result.metrics, result.best) == ({}, None)
    assert (tmp_path / "last.safetensors").is_file()
    assert not (tmp_path / "best.safetensors").exists()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"optimisation": {"samples_per_epoch": 1}}, "1 samples are no full batch of 2"),
        ({"data": {"source": "opv2v"}}, "data.root: must be set"),
    ],
)
def test_what_cannot_be_trained_is_said(
    config: TrainDetectorConfig, tmp_path: Path, changes: dict[str, Any], said: str
) -> None:
    source = None if "data" in changes else SOURCE
    with pytest.raises(ValueError, match=said):
        run(changed(config, **changes), tmp_path, source=source)


def test_an_unknown_device_is_said(config: TrainDetectorConfig, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="device 'tpu9' cannot be used"):
        run(config.model_copy(update={"device": "tpu9"}), tmp_path)


def test_nothing_global_changes(config: TrainDetectorConfig, tmp_path: Path) -> None:
    before, threads = torch.random.get_rng_state(), torch.get_num_threads()
    run(config, tmp_path)
    assert torch.equal(torch.random.get_rng_state(), before)
    assert torch.get_num_threads() == threads
