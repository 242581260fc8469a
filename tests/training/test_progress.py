"""What a training says of its steps is true, and a loss that is no number ends it."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import torch

from cobevglue.training import DivergedError, OptimisationConfig
from cobevglue.training.progress import EpochProgress
from cobevglue.training.run_log import RunLog

FOUR_STEPS = OptimisationConfig(epochs=3, samples_per_epoch=9, batch_size=2)


def progress(folder: Path, every: float, lines: list[str]) -> tuple[EpochProgress, RunLog]:
    log = RunLog(folder)
    return EpochProgress(FOUR_STEPS, 1, log, lines.append, every=every, name="coalign"), log


def test_epoch_has_full_batches_and_reports_mean(tmp_path: Path) -> None:
    lines: list[str] = []
    epoch, log = progress(tmp_path, 1e9, lines)
    assert list(epoch.steps) == [4, 5, 6, 7]  # of the second epoch
    assert epoch.all_steps == 12
    with log:
        for loss in (1.0, 2.0, 3.0, 6.0):
            epoch.add({"total": torch.tensor(loss)}, rate=1e-3)
    (line,) = lines
    assert line.startswith("coalign: epoch 2/3 step 8/12: total 3.000, lr 1.0e-03, ")
    (entry,) = [json.loads(text) for text in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert (entry["group"], entry["step"], entry["epoch"], entry["total"]) == ("epoch", 8, 1, 3.0)


def test_progress_lines_cover_the_last_interval(tmp_path: Path) -> None:
    epoch, log = progress(tmp_path, 0.0, [])
    with log:
        for loss in (1.0, 2.0, 3.0, 6.0):
            epoch.add({"total": torch.tensor(loss)}, rate=1e-3)
    entries = [json.loads(text) for text in (tmp_path / "log.jsonl").read_text().splitlines()]
    assert [(entry["group"], entry["step"], entry["total"]) for entry in entries] == [
        ("train", 5, 1.0),
        ("train", 6, 2.0),
        ("train", 7, 3.0),
        ("epoch", 8, 3.0),
    ]


@pytest.mark.parametrize("loss", [float("nan"), float("inf")])
def test_non_finite_loss_ends_training_with_advice(tmp_path: Path, loss: float) -> None:
    epoch, log = progress(tmp_path, 0.0, [])
    with log, pytest.raises(DivergedError, match=r"step 5; the state of epoch 1 is kept.*learning_rate"):
        epoch.add({"total": torch.tensor(loss)}, rate=1.0)


def test_too_few_samples_for_a_batch_raise() -> None:
    with pytest.raises(ValueError, match="9 samples are no full batch of 2 for each of 5 processes"):
        FOUR_STEPS.steps_per_epoch(processes=5)
