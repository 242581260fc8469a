"""Settings of a training run; the shipped ones by name, and a YAML file or single values that override them."""

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
"""Name of the data that are made while training."""

_Count = Annotated[int, Field(ge=1)]


class DataConfig(Settings):
    """Where samples come from.

    Attributes:
        source: "simulated", or the name of a data set in `DATASETS`.
        root: folder of the data set.
        split: what to train on; None for the source's own training split.
        validation_split: what to validate on; None for the source's own validation split.
        options: further settings of the source: those of `EpisodeSettings`, or arguments of `DatasetEpisodes`.
        reader: arguments of the data set's class, such as `labels` of DAIR-V2X or `left_handed` of V2V4Real.
        worlds: simulated worlds to train on, over and over; None for a new one each time.
        min_points: objects with fewer points are neither to be found nor wrong to find.
        pool: episodes whose samples are shuffled together, in each worker.
        uses: how often a sample is seen before it is forgotten, changed in another way each time; more where making
            samples takes longer than learning from them.
        workers: processes that make samples, for each training process; 0 makes them in the training process. Another
            number makes another order of samples.
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
        """The split to train or validate on, the source's own where none is set."""
        chosen = self.validation_split if validation else self.split
        if chosen is not None:
            return chosen
        if self.source == SIMULATED:
            return "validation" if validation else "train"
        dataset = DATASETS[self.source]
        return dataset.validation_split if validation else dataset.training_split


class ValidationConfig(Settings):
    """How the model is measured while it is trained.

    Attributes:
        every: epochs between validations; the last epoch is always validated.
        episodes: the first episodes of the validation split; they stay in memory. 0 for no validation.
        score: "ap_0.5" or "ap_0.7", by which the best model is chosen.
    """

    every: _Count = 1
    episodes: Annotated[int, Field(ge=0)] = 12
    score: Literal["ap_0.5", "ap_0.7"] = "ap_0.7"


class TrainDetectorConfig(Settings):
    """Settings of `train_detector`.

    Attributes:
        model: of the detector; a name in `CONFIGS` is taken, too.
        data: what to train on.
        augmentation: how samples are changed.
        optimisation: how weights are found.
        validation: how they are measured.
        seed: of the first weights, the order of samples and their changes.
        init_from: weights to start from, a file of an earlier run; the schedule starts anew.
        device: "auto" takes CUDA where there is one.
        threads: of torch on the CPU, in each training process; workers have one each.
        report_every: time between lines of progress [s].
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
"""A run may be resumed with other values of these."""

PRESETS: dict[str, TrainDetectorConfig] = {
    # As many samples as two cores get through in about an hour and a half. What an agent sees lies along its road, so
    # scenes are turned by no more than roads are, and not mirrored: which side traffic keeps to says which way a far
    # vehicle faces.
    "compact": TrainDetectorConfig(
        data=DataConfig(min_points=2),
        augmentation=AugmentationConfig(mirror=0.0, rotation=0.4),
        optimisation=OptimisationConfig(epochs=24, samples_per_epoch=500),
        validation=ValidationConfig(every=5, episodes=8),
    ),
    # What a GPU gets through in six minutes while 15 cores simulate for it.
    "opv2v": TrainDetectorConfig(
        model=CONFIGS["opv2v"],
        data=DataConfig(min_points=2, uses=2, workers=15),
        augmentation=AugmentationConfig(mirror=0.0, rotation=0.4),
        optimisation=OptimisationConfig(epochs=16, samples_per_epoch=6000, batch_size=16),
        validation=ValidationConfig(every=8, episodes=12),
    ),
    # Seconds, to see that everything works; it finds nothing.
    "tiny": TrainDetectorConfig(
        optimisation=OptimisationConfig(epochs=2, samples_per_epoch=8, batch_size=2),
        data=DataConfig(worlds=1, pool=1, workers=0),
        validation=ValidationConfig(episodes=1),
        report_every=1.0,
    ),
}
"""Shipped settings by name."""


def load_config(name_or_file: str, changes: Sequence[str] = ()) -> TrainDetectorConfig:
    """Settings by the name of a preset or from a YAML file, with single values changed.

    Args:
        name_or_file: a name in `PRESETS`, or a `.yaml` file with what differs from the default, or from the preset that
            its key `preset` names.
        changes: "key=value", with dots into nested settings and the value in YAML: "optimisation.epochs=3".

    Raises:
        ValueError: no such preset, an unknown key or a bad value; names the nearest valid one.
        FileNotFoundError: there is no such file.
    """
    return settings_from(PRESETS, "compact", name_or_file, changes)


Config = TypeVar("Config", bound=Settings)


def settings_from(
    presets: Mapping[str, Config], default: str, name_or_file: str, changes: Sequence[str] = ()
) -> Config:
    """See `load_config`; `default` is the preset of a file that names none."""
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
    if isinstance(value, str):  # YAML 1.1 takes 1e-3 for text
        with contextlib.suppress(ValueError):
            value = float(value)
    for name in reversed(key.split(".")):
        value = {name: value}
    return dict(value)


def _merged(base: Mapping[str, Any], changes: Mapping[str, Any]) -> dict[str, Any]:
    """`base` with `changes` put in, mapping by mapping; neither is changed."""
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
