"""The data and networks of a study: recorded or simulated sequences, detector and fusion weights."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import Annotated, Any

from pydantic import Field

from cobevglue.datasets import DATASETS, open_dataset
from cobevglue.datasets.frame import Frame, Scenario, did_you_mean
from cobevglue.settings import Settings

__all__ = ["SEED", "SIMULATED", "StudySettings", "open_sequence", "sequence_frames", "sequence_names"]

SIMULATED = "simulated"
"""Replaces a data set's name: sequences are simulated during the run."""
SEED = 2406
"""Seed of simulated sequences and their disturbances; not used for training, tuning or development."""

_SIMULATED_SEQUENCES, _SIMULATED_FRAMES = 24, 20  # two on each of the test networks
_AGENTS = (2, 3)
"""Numbers of agents of simulated sequences, alternating."""

_Count = Annotated[int, Field(ge=1)]


class StudySettings(Settings):
    """The data and networks of a study, without the conditions.

    Attributes:
        dataset: name in `DATASETS`, or "simulated".
        root: of the data set; None for simulated sequences.
        split: name of the split.
        reader: further arguments of the data set's class (`open_dataset`).
        scenarios: maximum number; None for all, or 24 simulated ones.
        frames: maximum number per scenario, from its start; None for all, or 20 simulated ones.
        seed: of all random numbers.
        detector: a shipped model's name, or a .safetensors file.
        weights: folder with the weights of fusion methods, `<name>.safetensors`; None for the shipped ones.
        untrained: use fusion methods without trained weights, with the detector's own neck and head.
        min_points: objects on which all agents together have fewer points are ignored.

    Raises:
        ValueError: a value out of its range.
    """

    dataset: str = SIMULATED
    root: str | None = None
    split: str = "test"
    reader: dict[str, Any] = Field(default_factory=dict)
    scenarios: _Count | None = None
    frames: _Count | None = None
    seed: Annotated[int, Field(ge=0)] = SEED
    detector: str = "compact"
    weights: str | None = None
    untrained: bool = False
    min_points: Annotated[int, Field(ge=0)] = 5

    @property
    def label(self) -> str:
        """Name of the data in tables."""
        return f"{self.dataset} {self.split}"


def sequence_names(settings: StudySettings) -> list[str]:
    """The names of the sequences of a study.

    Raises:
        ValueError: no such data set or split (names the nearest); it has no root, or simulated sequences have one.
        FileNotFoundError: there is no such data set at the root.
        ModuleNotFoundError: the simulation is not installed.
    """
    if settings.dataset == SIMULATED:
        if settings.root is not None:
            raise ValueError("simulated sequences have no root: they are simulated during the run")
        if settings.reader:
            raise ValueError(f"options of a data set's reader have no effect on simulated sequences: {settings.reader}")
        return [_simulated(settings, number).name for number in range(settings.scenarios or _SIMULATED_SEQUENCES)]
    if settings.dataset not in DATASETS:
        raise ValueError(f"no data set {did_you_mean(settings.dataset, [SIMULATED, *DATASETS])}")
    if settings.root is None:
        raise ValueError(f"the data set {settings.dataset} needs a root, its folder")
    names = open_dataset(settings.dataset, settings.root, settings.split, settings.reader).scenarios
    if not names:
        raise ValueError(f"{settings.root}: the split {settings.split!r} has no scenarios")
    return list(names[: settings.scenarios])


def open_sequence(settings: StudySettings, number: int) -> Scenario:
    """Sequence `number` of `sequence_names`; frames are read or simulated when they are used."""
    if settings.dataset == SIMULATED:
        return _simulated(settings, number)
    dataset = open_dataset(settings.dataset, settings.root or ".", settings.split, settings.reader)
    return dataset[dataset.scenarios[number]]


def sequence_frames(settings: StudySettings, sequence: Scenario) -> Iterator[Frame]:
    """The frames of a sequence that a study uses."""
    return islice(iter(sequence), settings.frames)


def _simulated(settings: StudySettings, number: int) -> Scenario:
    from cobevglue.simulation.scenario import ScenarioSettings, simulated_scenario

    agents = _AGENTS[number % len(_AGENTS)]
    scenario = ScenarioSettings(frames=settings.frames or _SIMULATED_FRAMES, agents=agents)
    return simulated_scenario(settings.split, number, settings.seed, scenario)
