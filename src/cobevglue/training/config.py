"""Settings of the training of a detector: presets, which a YAML file or single values override."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import yaml
from pydantic import Field, ValidationError, field_validator

from cobevglue.datasets import DATASETS
from cobevglue.datasets.frame import did_you_mean
from cobevglue.perception import CONFIGS, PointPillarsConfig
from cobevglue.settings import Settings
from cobevglue.training.augmentation import AugmentationConfig
from cobevglue.training.optimisation import OptimisationConfig

__all__ = ["PRESETS", "DataConfig", "TrainDetectorConfig", "ValidationConfig", "load_config", "settings_from"]

SIMULATED = "simulated"
"""Data source: simulation during training."""

_Count = Annotated[int, Field(ge=1)]


class DataConfig(Settings):
    """Source of training and validation samples.

    Attributes:
        source: "simulated", or the name of a data set in `DATASETS`.
        root: folder of the data set.
        split: training split; None for the default of the source.
        validation_split: None for the default of the source.
        options: further settings of the source: those of `EpisodeSettings`, or arguments of `DatasetEpisodes`.
        reader: arguments of the data set's class, such as `labels` of DAIR-V2X or `left_handed` of V2V4Real.
        worlds: number of simulated worlds for training; None for a new one in every episode.
        min_points: objects with fewer points are ignored, in training and validation.
        pool: number of episodes whose samples are shuffled together, in each worker.
        uses: number of times that a sample is used, with different augmentations; larger values help where loading
            or simulation is slower than training.
        workers: data-loading processes per training process; 0 loads in the training process. The order of samples
            depends on the number.
    """

    source: str = SIMULATED
    root: Path | None = None
    split: str | None = None
    validation_split: str | None = None
    options: dict[str, Any] = Field(default_factory=dict)
    reader: dict[str, Any] = Field(default_factory=dict)
    worlds: _Count | None = None
    min_points: Annotated[int, Field(ge=0)] = 5
    pool: _Count = 4
    uses: _Count = 1
    workers: Annotated[int, Field(ge=0)] = 1

    @field_validator("source")
    @classmethod
    def _known_source(cls, source: str) -> str:
        if source not in (SIMULATED, *DATASETS):
            raise ValueError(f"no data {did_you_mean(source, (SIMULATED, *DATASETS))}")
        return source

    def split_name(self, *, validation: bool) -> str:
        """Name of the training or validation split; the default of the source if none is set."""
        chosen = self.validation_split if validation else self.split
        if chosen is not None:
            return chosen
        if self.source == SIMULATED:
            return "validation" if validation else "train"
        dataset = DATASETS[self.source]
        return dataset.validation_split if validation else dataset.training_split


class ValidationConfig(Settings):
    """Settings of validation during training.

    Attributes:
        every: number of epochs between validations; the last epoch is always validated.
        episodes: number of episodes of the validation split, kept in memory; 0 disables validation.
        score: metric by which the best model is selected, "ap_0.5" or "ap_0.7".
    """

    every: _Count = 1
    episodes: Annotated[int, Field(ge=0)] = 12
    score: Literal["ap_0.5", "ap_0.7"] = "ap_0.7"


class TrainDetectorConfig(Settings):
    """Settings of `train_detector`.

    Attributes:
        model: settings of the detector, or a name in `CONFIGS`.
        data: source of samples.
        augmentation: settings.
        optimisation: settings.
        validation: settings.
        seed: of the initial weights, the order of samples and the augmentation.
        init_from: file of initial weights; the learning rate schedule starts anew.
        device: torch's name of a device, or "auto": CUDA if available.
        threads: number of torch's CPU threads in each training process; workers use one each.
        report_every: time between progress messages [s].
    """

    model: PointPillarsConfig = CONFIGS["compact"]
    data: DataConfig = DataConfig()
    augmentation: AugmentationConfig = AugmentationConfig()
    optimisation: OptimisationConfig = OptimisationConfig()
    validation: ValidationConfig = ValidationConfig()
    seed: Annotated[int, Field(ge=0)] = 0
    init_from: Path | None = None
    device: str = "auto"
    threads: _Count = 2
    report_every: Annotated[float, Field(gt=0.0)] = 20.0

    @field_validator("model", mode="before")
    @classmethod
    def _model_by_name(cls, model: Any) -> Any:
        if not isinstance(model, str):
            return model
        if model not in CONFIGS:
            raise ValueError(f"no model {did_you_mean(model, CONFIGS)}")
        return CONFIGS[model]


FREE_TO_CHANGE = {"device", "threads", "report_every", "init_from"}
"""Settings that may differ when a run is resumed."""

PRESETS: dict[str, TrainDetectorConfig] = {
    # About 90 minutes on two cores. Most objects are along the agent's road, so rotations are limited to those of
    # roads. Scenes are not mirrored: the side of the road on which a distant vehicle drives indicates its heading.
    "compact": TrainDetectorConfig(
        data=DataConfig(min_points=2),
        augmentation=AugmentationConfig(mirror=0.0, rotation=0.4),
        optimisation=OptimisationConfig(epochs=24, samples_per_epoch=500),
        validation=ValidationConfig(every=5, episodes=8),
    ),
    # Six minutes on a GPU, with 15 cores for the simulation.
    "opv2v": TrainDetectorConfig(
        model=CONFIGS["opv2v"],
        data=DataConfig(min_points=2, uses=2, workers=15),
        augmentation=AugmentationConfig(mirror=0.0, rotation=0.4),
        optimisation=OptimisationConfig(epochs=16, samples_per_epoch=6000, batch_size=16),
        validation=ValidationConfig(every=8, episodes=12),
    ),
    # Seconds, to test the installation; the result detects nothing.
    "tiny": TrainDetectorConfig(
        optimisation=OptimisationConfig(epochs=2, samples_per_epoch=8, batch_size=2),
        data=DataConfig(worlds=1, pool=1, workers=0),
        validation=ValidationConfig(episodes=1),
        report_every=1.0,
    ),
}
"""Presets by name."""


def load_config(name_or_file: str, changes: Sequence[str] = ()) -> TrainDetectorConfig:
    """Load settings from a preset or a YAML file, and override single values.

    Args:
        name_or_file: a name in `PRESETS`, or a `.yaml` file of overrides of a preset. The key `preset` names the
            preset; the default is "compact".
        changes: "key=value", with dots for nested settings and the value in YAML: "optimisation.epochs=3".

    Raises:
        ValueError: unknown preset, unknown key or bad value; the message names the nearest valid key.
        FileNotFoundError: the file does not exist.
    """
    return settings_from(PRESETS, "compact", name_or_file, changes)


Config = TypeVar("Config", bound=Settings)


def settings_from(
    presets: Mapping[str, Config], default: str, name_or_file: str, changes: Sequence[str] = ()
) -> Config:
    """`load_config` for any family of presets; `default` is the preset of a file without the key `preset`."""
    overrides: dict[str, Any] = {}
    preset, where = name_or_file, ""
    if name_or_file.endswith((".yaml", ".yml")):
        overrides = _read_yaml(Path(name_or_file))
        preset, where = str(overrides.pop("preset", default)), f"{name_or_file}: "
    if preset not in presets:
        raise ValueError(f"{where}no preset {did_you_mean(preset, presets)}")
    values = _merged(presets[preset].model_dump(), overrides)
    for change in changes:
        values = _merged(values, _one_change(change))
    try:
        return type(presets[preset]).model_validate(values)
    except ValidationError as error:
        raise ValueError(where + _first_problem(error)) from None


def _read_yaml(file: Path) -> dict[str, Any]:
    if not file.is_file():
        raise FileNotFoundError(f"{file} is not there")
    try:
        content = yaml.safe_load(file.read_text(encoding="utf-8"))
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ValueError(f"{file}: not readable as YAML: {' '.join(str(error).split())}") from None
    if not isinstance(content, dict | None):
        raise ValueError(f"{file}: must be a mapping of settings, got {type(content).__name__}")
    return content or {}


def _one_change(change: str) -> dict[str, Any]:
    key, equals, text = change.partition("=")
    if not equals or not key:
        raise ValueError(f"{change!r} must be key=value")
    try:
        value = yaml.safe_load(text)
    except yaml.YAMLError:
        raise ValueError(f"{change!r}: the value is not readable as YAML") from None
    if isinstance(value, str):  # in YAML 1.1, 1e-3 is a string
        with contextlib.suppress(ValueError):
            value = float(value)
    for name in reversed(key.split(".")):
        value = {name: value}
    return dict(value)


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """Merge nested mappings: `base` overridden by `changes`; the arguments are not modified."""
    result = dict(base)
    for key, value in changes.items():
        old = result.get(key)
        both = isinstance(old, Mapping) and isinstance(value, Mapping)
        result[key] = _merged(old, value) if both else value  # type: ignore[arg-type]
    return result


def _first_problem(error: ValidationError) -> str:
    problem = error.errors()[0]
    where = ".".join(str(part) for part in problem["loc"])
    message = problem["msg"].removeprefix("Value error, ")
    return f"{where}: {message}" if where else message
