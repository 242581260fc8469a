"""Training of a detector: `train_detector`."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import torch
from torch import nn
from torch.nn.parallel import DistributedDataParallel

from cobevglue.perception import DetectionLoss, PointPillars
from cobevglue.torch_threads import torch_threads
from cobevglue.training.batches import Batch, Batches
from cobevglue.training.checkpoint import LAST, STATE, begin_run, provenance, save_state
from cobevglue.training.config import FREE_TO_CHANGE, TrainDetectorConfig
from cobevglue.training.loader import batches
from cobevglue.training.optimisation import Learner, autocast
from cobevglue.training.processes import Processes, process_group
from cobevglue.training.progress import EpochProgress
from cobevglue.training.run_log import RunLog, print_progress
from cobevglue.training.samples import EpisodeSource
from cobevglue.training.sources import make_source
from cobevglue.training.stream import EpisodeStream
from cobevglue.training.validation import Validation

__all__ = ["TrainingResult", "train_detector"]

BEST = "best.safetensors"


@dataclass(frozen=True)
class TrainingResult:
    """Result of a training run.

    Attributes:
        folder: with `last.safetensors`, `best.safetensors` (of the best validation), `state.pt`, `log.jsonl` and
            TensorBoard's event files.
        epochs: number of completed epochs.
        finished: whether all epochs are completed; if not, the time limit was reached, and the run can be resumed.
        metrics: of the last validation; empty without validation.
        best: the best validation score; None without validation.
    """

    folder: Path
    epochs: int
    finished: bool
    metrics: dict[str, float]
    best: float | None


def train_detector(
    config: TrainDetectorConfig,
    folder: Path,
    *,
    resume: bool = False,
    max_minutes: float | None = None,
    source: EpisodeSource | None = None,
    validation_source: EpisodeSource | None = None,
    report: Callable[[str], None] = print_progress,
) -> TrainingResult:
    """Train a detector, or resume a run.

    The state is saved after each epoch. On the same machine with the same number of threads, a resumed run gives
    exactly the result of an uninterrupted one. Under `torchrun`, all processes train together, each on its own batches.

    Args:
        config: settings.
        folder: of the run; created if missing.
        resume: resume the run in `folder`.
        max_minutes: time limit: stop before an epoch that would exceed it, judged by the longest one so far. The first
            epoch is always completed.
        source: training samples, instead of those of `config.data`.
        validation_source: validation samples, instead of those of `config.data`.
        report: is called with each line of progress.

    Raises:
        ValueError: a new run in a folder that contains one; other settings than those of the run to resume; an
            unavailable device; a damaged file.
        FileNotFoundError: no state to resume from, or missing data or weights.
        DivergedError: the loss is not finite.
    """
    source = source or make_source(config.data, config.seed, validation=False)
    if config.validation.episodes and validation_source is None:
        validation_source = make_source(config.data, config.seed, validation=True)
    with torch_threads(config.threads), process_group(config.device) as processes:
        run = _Run(config, folder, processes, resume, report if processes.is_first else lambda _: None)
        return run.train(source, validation_source, max_minutes)


class _Run:
    """The state of a run in one process."""

    def __init__(
        self,
        config: TrainDetectorConfig,
        folder: Path,
        processes: Processes,
        resume: bool,
        report: Callable[[str], None],
    ) -> None:
        self.config, self.folder, self.processes, self.report = config, folder, processes, report
        optimisation = config.optimisation
        self.batches_per_epoch = optimisation.steps_per_epoch(processes.count)

        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(config.seed)
            self.model = PointPillars(config.model)  # its convolutions are channels-last
        self.model.heading_refiner.requires_grad_(False)  # trained afterwards by `train_heading`
        self.model.to(processes.device)
        self.loss = DetectionLoss(config.model)
        self.epoch, self.elapsed = 0, 0.0
        self.best: float | None = None
        state = begin_run(
            folder,
            config.model_dump(mode="json"),
            FREE_TO_CHANGE,
            resume=resume,
            processes=processes.count,
            device=processes.device,
        )
        if state is None and config.init_from is not None:
            _start_from(self.model, config.init_from)
        self.learner = Learner(self.model, optimisation, state)
        if state is not None:
            self.epoch, self.elapsed, self.best = state.epoch, state.elapsed, state.best
        self.net = self._distributed()
        if processes.device.type == "cuda":
            # All pillar images have the same size, so the search for the fastest kernels runs only once.
            torch.backends.cudnn.benchmark = True

    def train(
        self, source: EpisodeSource, validation_source: EpisodeSource | None, max_minutes: float | None
    ) -> TrainingResult:
        """Run the remaining epochs within the time limit."""
        config, processes = self.config, self.processes
        validation = None
        if validation_source is not None and config.validation.episodes:
            validation = Validation(config, validation_source, processes, self.loss)
        if processes.is_first:
            self.folder.mkdir(parents=True, exist_ok=True)
        metrics: dict[str, float] = {}
        started, longest = time.monotonic(), 0.0
        with RunLog(self.folder, self.epoch * self.batches_per_epoch, write=processes.is_first) as log:
            batches = self._batches(source)
            while self.epoch < config.optimisation.epochs:
                epoch_started = time.monotonic()
                self._train_epoch(batches, log)
                self.epoch += 1
                if validation is not None and (
                    self.epoch % config.validation.every == 0 or self.epoch == config.optimisation.epochs
                ):
                    metrics = self._validate(validation, log)
                epoch_time = time.monotonic() - epoch_started
                self.elapsed, longest = self.elapsed + epoch_time, max(longest, epoch_time)
                self._save(metrics)
                expected = (time.monotonic() - started + longest) / 60.0
                if processes.share(max_minutes is not None and expected > max_minutes):
                    break
        finished = self.epoch == config.optimisation.epochs
        if not finished:
            self.report(f"time is up after epoch {self.epoch} of {config.optimisation.epochs}; resume to go on")
        return TrainingResult(self.folder, self.epoch, finished, metrics, self.best)

    def _batches(self, source: EpisodeSource) -> Iterator[Batch]:
        """Batches of all remaining epochs: workers prefetch while this process validates or saves."""
        config, optimisation = self.config, self.config.optimisation
        ready = Batches(config.model, config.data.min_points, config.augmentation)
        stream = EpisodeStream(
            source,
            ready.prepare,
            epochs=range(self.epoch, optimisation.epochs),
            batches_per_epoch=self.batches_per_epoch,
            batch_size=optimisation.batch_size,
            seed=config.seed,
            pool=config.data.pool,
            uses=config.data.uses,
            rank=self.processes.rank,
            processes=self.processes.count,
        )
        workers = config.data.workers
        return batches(
            stream,
            optimisation.batch_size,
            workers,
            ready.collate,
            prefetch=4,
            pin_memory=self.processes.device.type == "cuda",
        )

    def _train_epoch(self, batches: Iterator[Batch], log: RunLog) -> None:
        config, optimisation, processes = self.config, self.config.optimisation, self.processes
        progress = EpochProgress(
            optimisation, self.epoch, log, self.report, every=config.report_every, processes=processes.count
        )
        self.net.train()
        for step in progress.steps:
            asked = time.monotonic()
            batch = next(batches)
            waited = time.monotonic() - asked
            with autocast(optimisation, processes.device):
                output = self.net(batch.clouds(processes.device))
            terms = self.loss(output, batch.targets.to(processes.device))
            rate, norm = self.learner.learn(terms.total, step, progress.all_steps)
            progress.add({**terms._asdict(), "gradient": norm}, rate, waited)

    def _validate(self, validation: Validation, log: RunLog) -> dict[str, float]:
        """Validate the mean weights and save the best model so far; returns the same metrics in all processes."""
        started = time.monotonic()
        metrics: dict[str, float] = self.processes.share(validation.measure(self.learner.mean))
        log.add("validation", self.epoch * self.batches_per_epoch, self.epoch, metrics)
        listed = " ".join(f"{name} {value:.3f}" for name, value in metrics.items())
        self.report(f"epoch {self.epoch} validated in {time.monotonic() - started:.0f} s: {listed}")
        score = metrics[self.config.validation.score]
        if math.isfinite(score) and (self.best is None or score > self.best):
            self.best = score
            self._save_model(BEST, metrics)
        return metrics

    def _save(self, metrics: dict[str, float]) -> None:
        if not self.processes.is_first:
            return
        self._save_model(LAST, metrics)
        state = self.learner.state(self.config, self.epoch, self.elapsed, self.processes.count, self.best)
        save_state(self.folder / STATE, state)

    def _save_model(self, name: str, metrics: dict[str, float]) -> None:
        if not self.processes.is_first:
            return
        metadata = {
            **provenance(),
            "training": self.config.model_dump(mode="json"),
            "epoch": self.epoch,
            "metrics": {name: value if math.isfinite(value) else None for name, value in metrics.items()},
        }
        self.learner.mean.save(self.folder / name, metadata)

    def _distributed(self) -> nn.Module:
        if self.processes.count == 1:
            return self.model
        cuda = self.processes.device.type == "cuda"
        # The layers are replaced in place with the same parameters, so optimiser and checkpoints are unaffected.
        model: nn.Module = nn.SyncBatchNorm.convert_sync_batchnorm(self.model) if cuda else self.model  # type: ignore[no-untyped-call]
        return DistributedDataParallel(model, device_ids=[self.processes.device] if cuda else None)


def _start_from(model: PointPillars, path: Path) -> None:
    """Load initial weights. Ranges and thresholds may differ, the network may not."""
    theirs, ours = PointPillars.load(path).state_dict(), model.state_dict()
    wrong = [
        name
        for name in {**ours, **theirs}
        if name not in ours or name not in theirs or ours[name].shape != theirs[name].shape
    ]
    if wrong:
        raise ValueError(f"{path}: weights of another network; {len(wrong)} differ, the first is {wrong[0]}")
    model.load_state_dict(theirs)
