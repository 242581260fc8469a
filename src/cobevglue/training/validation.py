"""Validation of a detector during training: loss and average precision on fixed episodes."""

from __future__ import annotations

import torch

from cobevglue.evaluation.detection import DetectionFrame, evaluate_detections
from cobevglue.perception import DetectionLoss, PointPillars
from cobevglue.training import loader
from cobevglue.training.batches import Batch, Batches
from cobevglue.training.config import TrainDetectorConfig
from cobevglue.training.optimisation import autocast
from cobevglue.training.processes import Processes
from cobevglue.training.samples import EpisodeSource
from cobevglue.training.stream import FixedStream

__all__ = ["Validation"]


class Validation:
    """Validation episodes of a run, distributed over processes; computed at the first use and cached."""

    def __init__(
        self, config: TrainDetectorConfig, source: EpisodeSource, processes: Processes, loss: DetectionLoss
    ) -> None:
        self._config, self._source, self._processes, self._loss = config, source, processes, loss
        self._batches: list[Batch] | None = None

    def measure(self, model: PointPillars) -> dict[str, float]:
        """Mean loss terms, "ap_0.5" and "ap_0.7" of a model in evaluation mode; {} in all but the first process.

        AP ignores objects with fewer than `data.min_points` points; it is NaN without evaluated objects.
        """
        if self._batches is None:
            self._batches = self._make_batches()
        device = self._processes.device
        sums: dict[str, float] = {}
        frames: list[DetectionFrame] = []
        with torch.inference_mode():
            for batch in self._batches:
                clouds = batch.clouds(device)
                with autocast(self._config.optimisation, device):
                    output = model(clouds)
                for name, value in self._loss(output, batch.targets.to(device))._asdict().items():
                    sums[name] = sums.get(name, 0.0) + float(value) * len(clouds)
                for found, (truth, point_count) in zip(model.boxes(output), batch.truth, strict=True):
                    frames.append(DetectionFrame(found.boxes, truth, point_count))
        parts = self._processes.gather((sums, frames))
        if not parts:
            return {}
        return _summary([part[0] for part in parts], [frame for part in parts for frame in part[1]], self._config)

    def _make_batches(self) -> list[Batch]:
        config = self._config
        batches = Batches(config.model, config.data.min_points, None)
        stream = FixedStream(
            self._source,
            batches.prepare,
            range(self._processes.rank, config.validation.episodes, self._processes.count),
        )
        return list(loader.batches(stream, config.optimisation.batch_size, config.data.workers, batches.collate))


def _summary(
    sums: list[dict[str, float]], frames: list[DetectionFrame], config: TrainDetectorConfig
) -> dict[str, float]:
    if not frames:
        raise ValueError(f"the {config.validation.episodes} validation episodes have no samples")
    names = dict.fromkeys(name for part in sums for name in part)
    losses = {name: sum(part.get(name, 0.0) for part in sums) / len(frames) for name in names}
    report = evaluate_detections(frames, thresholds=(0.5, 0.7), min_points=config.data.min_points)
    return {**losses, "ap_0.5": report.ap(0.5), "ap_0.7": report.ap(0.7)}
