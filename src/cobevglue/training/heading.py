"""Training of a detector's heading refinement: `train_heading`. Takes minutes on a CPU."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor

from cobevglue.perception import PointPillars
from cobevglue.perception.heading import HeadingInputs, HeadingRefiner
from cobevglue.settings import Settings
from cobevglue.torch_device import chosen_device
from cobevglue.torch_threads import torch_threads
from cobevglue.training.checkpoint import LAST, begin_run
from cobevglue.training.config import DataConfig, settings_from
from cobevglue.training.detector import TrainingResult
from cobevglue.training.epochs import run_epochs
from cobevglue.training.heading_examples import HeadingExamples, write_heading_examples
from cobevglue.training.optimisation import Learner, OptimisationConfig, autocast
from cobevglue.training.progress import EpochProgress
from cobevglue.training.run_log import RunLog, print_progress
from cobevglue.training.sources import make_source

__all__ = [
    "HEADING_PRESETS",
    "HeadingAugmentation",
    "TrainHeadingConfig",
    "augmented",
    "load_heading_config",
    "train_heading",
]

_STAGE = "heading"
_SAMPLE_STREAM = 100

_Count = Annotated[int, Field(ge=1)]
_Share = Annotated[float, Field(ge=0.0, lt=1.0)]


class HeadingAugmentation(Settings):
    """Settings of the augmentation: variation of shapes, sensors and traffic, and dropout of inputs.

    Attributes:
        thinning: maximum share of the points on a vehicle that are dropped.
        jitter: standard deviation of the noise on each coordinate of a point [m].
        stretch: maximum relative change of scale along each axis.
        alone: share of vehicles whose surrounding boxes are removed.
        unsure: share of vehicles whose heading confidence is set to 0.
    """

    thinning: _Share = 0.7
    jitter: Annotated[float, Field(ge=0.0, le=1.0)] = 0.02
    stretch: _Share = 0.06
    alone: _Share = 0.2
    unsure: _Share = 0.2


class TrainHeadingConfig(Settings):
    """Settings of `train_heading`.

    Attributes:
        detector: name of shipped weights, or file of a run. Its other weights are not changed.
        data: source of clouds; `pool`, `uses` and `workers` have no effect here.
        episodes: number of training episodes.
        validation_episodes: number of validation episodes, used after the last epoch.
        examples: folder of the examples (detections in the clouds); missing ones are computed first.
        augmentation: settings.
        optimisation: settings; a sample is a vehicle.
        seed: of the episodes, the initial weights, the order of samples and the augmentation.
        init_from: a detector, given as for `detector`, with the initial weights of the heading refinement.
        device: torch's name of a device, or "auto": CUDA if available.
        threads: number of torch's threads, and of processes that compute examples.
        report_every: time between progress messages [s].
    """

    detector: str = "compact"
    data: DataConfig = DataConfig(min_points=2)
    episodes: _Count = 1800
    validation_episodes: _Count = 24
    examples: Path = Path("runs/heading-examples")
    augmentation: HeadingAugmentation = HeadingAugmentation()
    optimisation: OptimisationConfig = OptimisationConfig(
        epochs=15, samples_per_epoch=400_000, batch_size=256, learning_rate=3e-3, warm_up=0.3, mean_decay=0.99
    )
    seed: Annotated[int, Field(ge=0)] = 0
    init_from: str | None = None
    device: str = "auto"
    threads: _Count = 2
    report_every: Annotated[float, Field(gt=0.0)] = 20.0


FREE_TO_CHANGE = {"examples", "device", "threads", "report_every"}
"""Settings that may differ when a run is resumed."""


def train_heading(
    config: TrainHeadingConfig,
    folder: Path,
    *,
    resume: bool = False,
    report: Callable[[str], None] = print_progress,
) -> TrainingResult:
    """Train the heading refinement of a detector, or resume a run.

    Args:
        config: settings.
        folder: of the run; created if missing. The state is saved after each epoch; `last.safetensors` is the whole
            detector.
        resume: resume the run in `folder`.
        report: is called with each line of progress.

    Raises:
        ValueError: a new run in a folder that contains one; other settings than those of the run to resume; bad data.
        FileNotFoundError: no state to resume from, or missing weights or data.
        DivergedError: the loss is not finite.
    """
    with torch_threads(config.threads):
        return _train(config, folder, resume, chosen_device(config.device), report)


def _train(
    config: TrainHeadingConfig, folder: Path, resume: bool, device: torch.device, report: Callable[[str], None]
) -> TrainingResult:
    detector = PointPillars.named(config.detector)
    # Keep the training metadata of the detector, except that of a heading refinement, which is replaced.
    earlier = detector.metadata.get("stages", [detector.metadata])
    detector.metadata = {"stages": [stage for stage in earlier if stage.get("stage") != _STAGE]}
    state = begin_run(folder, config.model_dump(mode="json"), FREE_TO_CHANGE, resume=resume, device=device)
    training, validation = (_examples(config, detector, measured, device, report) for measured in (False, True))

    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(config.seed)
        net = HeadingRefiner().to(device)
    if config.init_from is not None:
        net.load_state_dict(PointPillars.named(config.init_from).heading_refiner.state_dict())
    learner = Learner(net, config.optimisation, state)

    def save(metadata: dict[str, object]) -> None:
        detector.heading_refiner.load_state_dict(learner.mean.state_dict())
        detector.save(folder / LAST, {"stage": _STAGE, **metadata})

    metrics = run_epochs(
        config,
        folder,
        learner,
        state,
        train=lambda epoch, log: _train_epoch(config, training, learner, epoch, log, report),
        validate=lambda: _validate(learner.mean, validation, report),
        save=save,
    )
    return TrainingResult(folder, config.optimisation.epochs, True, metrics, None)


def _examples(
    config: TrainHeadingConfig,
    detector: PointPillars,
    measured: bool,
    device: torch.device,
    report: Callable[[str], None],
) -> HeadingExamples:
    """Examples of the training split, or of the validation split if `measured`, on `device`."""
    split = config.data.split_name(validation=measured)
    described = {
        **config.data.model_dump(mode="json", exclude={"split", "validation_split", "pool", "uses", "workers"}),
        "split": split,
        "precision": config.optimisation.precision,
        "seed": config.seed,
        "episodes": config.validation_episodes if measured else config.episodes,
    }
    source = make_source(config.data, config.seed, validation=measured)
    folder = config.examples / split
    precision = autocast(config.optimisation, device)
    examples = write_heading_examples(folder, source, described, detector, config.threads, precision, device, report)
    return examples.to(device)


def _train_epoch(
    config: TrainHeadingConfig,
    examples: HeadingExamples,
    learner: Learner[HeadingRefiner],
    epoch: int,
    log: RunLog,
    report: Callable[[str], None],
) -> None:
    optimisation = config.optimisation
    progress = EpochProgress(optimisation, epoch, log, report, every=config.report_every)
    rng = np.random.default_rng([config.seed, _SAMPLE_STREAM, epoch])
    device = examples.correct.device
    random = torch.Generator(device).manual_seed(int(rng.integers(2**63)))
    learner.model.train()
    for step in progress.steps:
        rows = torch.from_numpy(rng.integers(len(examples.correct), size=optimisation.batch_size))
        batch = examples.take(rows.to(device))
        inputs = augmented(batch.inputs, config.augmentation, random)
        with autocast(optimisation, device):
            logits = learner.model(inputs)
        loss = F.binary_cross_entropy_with_logits(logits, batch.correct.float())
        rate, _ = learner.learn(loss, step, progress.all_steps)
        flipped = ((logits.detach() > 0) != batch.correct).float().mean()
        progress.add({"total": loss, "flipped": flipped}, rate)


def augmented(inputs: HeadingInputs, config: HeadingAugmentation, random: torch.Generator) -> HeadingInputs:
    """Augment the inputs for K vehicles; their true headings do not change.

    Args:
        inputs: with points in float32.
        config: settings of the augmentation.
        random: generator on the device of the inputs.
    """
    points, number, vehicle, around = inputs
    k, most = points.shape[:2]

    def uniform(*shape: int) -> Tensor:
        return torch.rand(shape, generator=random, device=points.device)

    left = (number * (1.0 - config.thinning * uniform(k))).ceil().long()
    behind = torch.arange(most, device=points.device) >= number[:, None]
    order = (uniform(k, most) + behind).argsort(dim=1)  # random order, padding last
    points = points.gather(1, order[..., None].expand(-1, -1, 3))
    points = points * (1.0 + config.stretch * (2.0 * uniform(k, 1, 3) - 1.0))
    points = points + config.jitter * torch.randn(points.shape, generator=random, device=points.device)
    around = around * (uniform(k, 1, 1) >= config.alone)
    vehicle = torch.cat([vehicle[:, :8], vehicle[:, 8:] * (uniform(k, 1) >= config.unsure)], dim=1)
    return HeadingInputs(points, left, vehicle, around)


@torch.inference_mode()
def _validate(net: HeadingRefiner, examples: HeadingExamples, report: Callable[[str], None]) -> dict[str, float]:
    """The loss, and the share of vehicles with a heading error above 90 degrees before and after refinement."""
    correct = examples.correct
    every = torch.arange(len(correct), device=correct.device)
    logits = torch.cat([net(examples.take(rows).inputs) for rows in torch.split(every, 1024)])
    metrics = {
        "loss": float(F.binary_cross_entropy_with_logits(logits, correct.float())),
        "flipped_before": float((~correct).float().mean()),
        "flipped": float(((logits >= 0) != correct).float().mean()),
    }
    report("validated: " + " ".join(f"{name} {value:.4f}" for name, value in metrics.items()))
    return metrics


HEADING_PRESETS: dict[str, TrainHeadingConfig] = {
    "compact": TrainHeadingConfig(),
    "opv2v": TrainHeadingConfig(detector="opv2v"),
}
"""Presets by the name of the detector."""


def load_heading_config(name_or_file: str, changes: Sequence[str] = ()) -> TrainHeadingConfig:
    """Load settings by name or from a YAML file, and override single values; see `load_config`.

    Raises:
        ValueError: unknown preset, unknown key or bad value; the message names the nearest valid key.
        FileNotFoundError: the file does not exist.
    """
    return settings_from(HEADING_PRESETS, "compact", name_or_file, changes)
