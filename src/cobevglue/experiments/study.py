"""What a study is run on: the drives of a data set or simulated ones, and the networks."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import islice
from typing import Annotated, Any

from pydantic import Field

from cobevglue.datasets import DATASETS, open_dataset
from cobevglue.datasets.frame import Frame, Scenario, did_you_mean
from cobevglue.settings import Settings

__all__ = ["SEED", "SIMULATED", "StudySettings", "drive_frames", "drive_names", "open_drive"]

SIMULATED = "simulated"
"""In the place of a data set's name: drives that are made on the way."""
SEED = 2406
"""Of simulated drives and of everything that goes wrong in them; nothing was trained, tuned or tried on this one."""

_SIMULATED_DRIVES, _SIMULATED_FRAMES = 24, 20  # two on each of the test networks
_AGENTS = (2, 3)
"""Of simulated drives, in turn."""

_Count = Annotated[int, Field(ge=1)]


class StudySettings(Settings):
    """The data and the networks: everything but the conditions that they are run under.

    Attributes:
        dataset: name in `DATASETS`, or "simulated".
        root: of the data set; None for simulated drives.
        split: name of the split.
        reader: further arguments of the data set's class (`open_dataset`).
        scenarios: so many at most; None for all, 24 of simulated ones.
        frames: of each scenario, from its beginning, so many at most; None for all, 20 of simulated ones.
        seed: of all that is random.
        detector: a shipped model's name, or a .safetensors file.
        weights: folder with the weights of fusion methods, `<name>.safetensors`; None for those that are shipped.
        untrained: take methods as they are made, without any weights: with the detector's own neck and head.
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
        """What tables call the data."""
        return f"{self.dataset} {self.split}"


def drive_names(settings: StudySettings) -> list[str]:
    """The drives that a study goes through.

    Raises:
        ValueError: no such data set or split (names the nearest); it has no root, or simulated drives have one.
        FileNotFoundError: there is no such data set at the root.
        ModuleNotFoundError: the simulation is not installed.
    """
    if settings.dataset == SIMULATED:
        if settings.root is not None:
            raise ValueError("simulated drives have no root: they are made on the way")
        if settings.reader:
            raise ValueError(f"options of a data set's reader have no effect on simulated drives: {settings.reader}")
        return [_simulated(settings, number).name for number in range(settings.scenarios or _SIMULATED_DRIVES)]
    if settings.dataset not in DATASETS:
        raise ValueError(f"no data set {did_you_mean(settings.dataset, [SIMULATED, *DATASETS])}")
    if settings.root is None:
        raise ValueError(f"the data set {settings.dataset} needs a root, the folder where it is")
    names = open_dataset(settings.dataset, settings.root, settings.split, settings.reader).scenarios
    if not names:
        raise ValueError(f"{settings.root}: the split {settings.split!r} has no scenarios")
    return list(names[: settings.scenarios])


def open_drive(settings: StudySettings, number: int) -> Scenario:
    """Drive `number` of `drive_names`; nothing is read or simulated before a frame is used."""
    if settings.dataset == SIMULATED:
        return _simulated(settings, number)
    dataset = open_dataset(settings.dataset, settings.root or ".", settings.split, settings.reader)
    return dataset[dataset.scenarios[number]]


def drive_frames(settings: StudySettings, drive: Scenario) -> Iterator[Frame]:
    """The frames of a drive that a study looks at."""
    return islice(iter(drive), settings.frames)


def _simulated(settings: StudySettings, number: int) -> Scenario:
    from cobevglue.simulation.scenario import ScenarioSettings, simulated_scenario

    agents = _AGENTS[number % len(_AGENTS)]
    drive = ScenarioSettings(frames=settings.frames or _SIMULATED_FRAMES, agents=agents)
    return simulated_scenario(settings.split, number, settings.seed, drive)
