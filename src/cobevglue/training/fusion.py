"""Training of a fusion method on the frozen features of a detector: `train_fusion`. Takes minutes on a CPU."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
from pydantic import Field
from torch import nn
from torch.utils.data import Dataset

from cobevglue.evaluation.detection import DetectionFrame, evaluate_detections
from cobevglue.fusion import FUSION_METHODS, FusionSample, IntermediateFusion, fusion_class, weights_name
from cobevglue.fusion.disconet import DiscoNet, EarlyTeacher
from cobevglue.perception import AnchorGrid, DetectionLoss, PointPillars, Targets, assign_targets, collate_targets
from cobevglue.se2 import SE2
from cobevglue.settings import Settings
from cobevglue.torch_threads import torch_threads
from cobevglue.training.checkpoint import LAST, begin_run
from cobevglue.training.config import settings_from
from cobevglue.training.detector import TrainingResult
from cobevglue.training.epochs import run_epochs
from cobevglue.training.fusion_features import FeatureConfig, FusionFrame, FusionFrames, write_features
from cobevglue.training.loader import batches
from cobevglue.training.optimisation import Learner, OptimisationConfig, autocast
from cobevglue.training.progress import EpochProgress
from cobevglue.training.run_log import RunLog, print_progress

__all__ = ["FUSION_PRESETS", "TrainFusionConfig", "load_fusion_config", "train_fusion"]

TEACHER = "disconet-teacher"
"""Name of DiscoNet's teacher, in place of a method's name."""

_NORM_MOMENTUM = 0.1
"""Momentum of the batch normalisation: with the detector's 0.01 the initial statistics would not decay in a run."""

_SAMPLE_STREAM = 90


class TrainFusionConfig(Settings):
    """Settings of `train_fusion`.

    Attributes:
        method: a name in `FUSION_METHODS` that shares features, or "disconet-teacher".
        detector: name of shipped weights, or file of a run; its features are frozen.
        features: folder of the frozen features, shared by all methods; missing ones are computed first.
        train: training frames.
        validation: validation frames, used after the last epoch.
        alone: share of samples with the ego as the only agent.
        noise: standard deviation of x and y [m] and yaw [degrees] of every agent's pose; None for the value of the
            method's paper.
        teacher: weights of DiscoNet's teacher; None trains without distillation.
        optimisation: settings.
        seed: of the initial weights, the order of samples and the pose noise.
        threads: number of torch's threads, and of processes that compute features.
        workers: number of data-loading processes; 0 loads in the training process.
        report_every: time between progress messages [s].
    """

    method: str
    detector: str = "compact"
    features: Path = Path("runs/fusion-features")
    train: FeatureConfig = FeatureConfig()
    validation: FeatureConfig = FeatureConfig(split="validation", scenarios=16)
    alone: Annotated[float, Field(ge=0.0, le=1.0)] = 0.2
    noise: tuple[Annotated[float, Field(ge=0.0)], Annotated[float, Field(ge=0.0)]] | None = None
    teacher: Path | None = None
    optimisation: OptimisationConfig = OptimisationConfig(
        epochs=3, samples_per_epoch=1000, learning_rate=3e-3, warm_up=0.05, mean_decay=0.99
    )
    seed: Annotated[int, Field(ge=0)] = 0
    threads: Annotated[int, Field(ge=1)] = 2
    workers: Annotated[int, Field(ge=0)] = 0
    report_every: Annotated[float, Field(gt=0.0)] = 20.0


FREE_TO_CHANGE = {"features", "threads", "workers", "report_every", "teacher"}
"""Settings that may differ when a run is resumed."""


@dataclass(frozen=True, slots=True, eq=False)
class _Item:
    sample: FusionSample
    targets: Targets


class _Samples(Dataset[_Item]):
    """The preprocessed samples of one epoch: frames in random order, with pose noise.

    The ego is a random agent of the frame. Features of the merged cloud exist for the first agent only, so it is the
    ego for methods that use them (`merged`).
    """

    def __init__(
        self,
        frames: FusionFrames,
        order: Sequence[int],
        noise: tuple[float, float],
        alone: float,
        merged: bool,
        seed: tuple[int, ...],
        anchors: AnchorGrid,
    ) -> None:
        self._frames, self._order, self._noise, self._alone = frames, order, noise, alone
        self._merged, self._seed, self._anchors = merged, seed, anchors

    def __len__(self) -> int:
        return len(self._order)

    def __getitem__(self, index: int) -> _Item:
        rng = np.random.default_rng([*self._seed, index])
        frame = self._frames[self._order[index]]
        ego = int(rng.integers(len(frame.observations)))
        frame = frame.with_ego(0 if self._merged else ego)
        agents = 1 if rng.random() < self._alone else len(frame.observations)
        return _Item(
            _sample(frame, agents, self._noise, rng),
            assign_targets(
                np.column_stack([frame.truth.center, frame.truth.size, frame.truth.yaw]), frame.ignored, self._anchors
            ),
        )


def train_fusion(
    config: TrainFusionConfig,
    folder: Path,
    *,
    resume: bool = False,
    report: Callable[[str], None] = print_progress,
) -> TrainingResult:
    """Train a fusion method, with the encoder frozen, or resume a run.

    Args:
        config: settings.
        folder: of the run; created if missing. The state is saved after each epoch.
        resume: resume the run in `folder`.
        report: is called with each line of progress.

    Raises:
        ValueError: a method without weights; a new run in a folder that contains one; other settings than those of the
            run to resume.
        FileNotFoundError: no state to resume from, or missing weights.
        DivergedError: the loss is not finite.
    """
    with torch_threads(config.threads):
        return _train(config, folder, resume, report)


def _train(config: TrainFusionConfig, folder: Path, resume: bool, report: Callable[[str], None]) -> TrainingResult:
    optimisation = config.optimisation
    detector = PointPillars.named(config.detector)
    model = _make_model(config, detector)
    state = begin_run(folder, config.model_dump(mode="json"), FREE_TO_CHANGE, resume=resume)
    frames, validation = (
        write_features(config.features / wanted.split, wanted, detector, report, config.threads)
        for wanted in (config.train, config.validation)
    )

    loss, anchors = DetectionLoss(detector.config), AnchorGrid(detector.config)
    learner = Learner(model, optimisation, state)
    noise = config.noise if config.noise is not None else model.training_noise
    count = optimisation.steps_per_epoch() * optimisation.batch_size

    def train(epoch: int, log: RunLog) -> None:
        seed = (config.seed, _SAMPLE_STREAM, epoch)
        rng = np.random.default_rng(seed)
        order = np.concatenate([rng.permutation(len(frames)) for _ in range(-(-count // len(frames)))])[:count]
        merged = model.learns_from_merged_clouds
        samples = _Samples(frames, order.tolist(), noise, config.alone, merged, seed, anchors)
        _train_epoch(config, samples, learner, loss, epoch, log, report)

    metrics = run_epochs(
        config,
        folder,
        learner,
        state,
        train=train,
        validate=lambda: _validate(learner.mean, validation, report) if len(validation) else {},
        save=lambda metadata: learner.mean.save(folder / LAST, metadata),
    )
    return TrainingResult(folder, optimisation.epochs, True, metrics, metrics.get("ap_0.7"))


def _train_epoch(
    config: TrainFusionConfig,
    samples: _Samples,
    learner: Learner[IntermediateFusion],
    loss: DetectionLoss,
    epoch: int,
    log: RunLog,
    report: Callable[[str], None],
) -> None:
    optimisation = config.optimisation
    loader = batches(samples, optimisation.batch_size, config.workers, list)
    progress = EpochProgress(optimisation, epoch, log, report, every=config.report_every, name=config.method)
    model = learner.model.train()
    anchors = len(model.anchors)
    asked = time.monotonic()
    for step, items in zip(progress.steps, loader, strict=True):
        waited = time.monotonic() - asked
        targets = collate_targets([item.targets for item in items], anchors)
        with autocast(optimisation, torch.device("cpu")):
            terms = model.loss([item.sample for item in items], targets, loss)
        rate, norm = learner.learn(terms["total"], step, progress.all_steps)
        progress.add({**terms, "gradient": norm}, rate, waited)
        asked = time.monotonic()


def _validate(model: IntermediateFusion, frames: FusionFrames, report: Callable[[str], None]) -> dict[str, float]:
    """AP in the detector's range with true poses; objects that training ignores are ignored here, too."""
    found = []
    rng = np.random.default_rng(0)  # has no effect: the noise is 0
    with torch.inference_mode():
        for index in range(len(frames)):
            frame = frames[index]
            (one,) = model.boxes(model([_sample(frame, len(frame.observations), (0.0, 0.0), rng)]))
            counts = np.where(frame.ignored, 0, 1)
            found.append(DetectionFrame(one.boxes, frame.truth, counts))
    (x_min, x_max), (y_min, y_max) = model.config.x_range, model.config.y_range
    result = evaluate_detections(
        found, thresholds=(0.5, 0.7), evaluation_range=(x_min, x_max, y_min, y_max), min_points=1
    )
    metrics = {"ap_0.5": result.ap(0.5), "ap_0.7": result.ap(0.7)}
    report("validated on true poses: " + " ".join(f"{name} {value:.3f}" for name, value in metrics.items()))
    return metrics


def _sample(frame: FusionFrame, agents: int, noise: tuple[float, float], rng: np.random.Generator) -> FusionSample:
    """Sample of the first `agents` of a frame, with noise on the pose of every agent, the ego included."""
    world_SE2_true = [SE2.from_matrix(pose) for pose in frame.world_SE3_agent[:agents]]
    deviation = np.array([noise[0], noise[0], math.radians(noise[1])])
    world_SE2_claimed = [
        SE2(*(np.array([pose.x, pose.y, pose.yaw]) + rng.normal(size=3) * deviation)) for pose in world_SE2_true
    ]

    def in_ego_frame(world: Sequence[SE2]) -> list[SE2]:
        return [SE2(), *(world[0].inverse() @ pose for pose in world[1:])]

    return FusionSample(
        observations=frame.observations[:agents],
        ego_SE2_agent=in_ego_frame(world_SE2_claimed),
        true_ego_SE2_agent=in_ego_frame(world_SE2_true),
        early_features=frame.early_features if agents == len(frame.observations) else None,
        truth=frame.truth[~frame.ignored],
    )


def _make_model(config: TrainFusionConfig, detector: PointPillars) -> IntermediateFusion:
    made = EarlyTeacher if config.method == TEACHER else fusion_class(config.method)
    if not issubclass(made, IntermediateFusion):
        raise ValueError(f"method: {config.method!r} has nothing to train")
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        model = made(detector)
    if isinstance(model, DiscoNet) and config.teacher is not None:
        model.teacher = EarlyTeacher(detector).load(config.teacher)
    for module in model.modules():
        if isinstance(module, nn.BatchNorm2d):
            module.momentum = _NORM_MOMENTUM
    return model


_DEFAULT = TrainFusionConfig.model_fields["optimisation"].default
_SLOWER = {"fpv-rcnn", "v2vnet-robust", "v2x-vit"}
"""Methods that were tried only at a third of the default learning rate."""

FUSION_PRESETS: dict[str, TrainFusionConfig] = {
    name: TrainFusionConfig(
        method=name,
        optimisation=_DEFAULT.model_copy(update={"learning_rate": 1e-3} if name in _SLOWER else {}),
    )
    for name, method in FUSION_METHODS.items()
    if issubclass(method, IntermediateFusion) and weights_name(name) == name
}
FUSION_PRESETS[TEACHER] = TrainFusionConfig(method=TEACHER)
FUSION_PRESETS["disconet"] = TrainFusionConfig(
    method="disconet", teacher=Path("runs/fusion") / TEACHER / "last.safetensors"
)
"""Presets by the name of the method."""


def load_fusion_config(name_or_file: str, changes: Sequence[str] = ()) -> TrainFusionConfig:
    """Load settings by the name of a method or from a YAML file, and override single values; see `load_config`.

    Raises:
        ValueError: unknown preset, unknown key or bad value; the message names the nearest valid key.
        FileNotFoundError: the file does not exist.
    """
    return settings_from(FUSION_PRESETS, "cobevglue", name_or_file, changes)
