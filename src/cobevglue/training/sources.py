"""Source of samples of a configuration."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from cobevglue.datasets import open_dataset
from cobevglue.datasets.labelled_cloud import LabelledCloud
from cobevglue.training.config import SIMULATED, DataConfig
from cobevglue.training.samples import DatasetEpisodes, EpisodeSource

__all__ = ["Repeated", "make_source"]


@dataclass(frozen=True)
class Repeated:
    """Repeats the first episodes of a source."""

    source: EpisodeSource
    episodes: int

    def episode(self, index: int) -> Sequence[LabelledCloud]:
        """Episode `index` modulo `episodes`; see `EpisodeSource`."""
        return self.source.episode(index % self.episodes)


def make_source(config: DataConfig, seed: int, *, validation: bool) -> EpisodeSource:
    """Open the source of training or validation samples.

    Args:
        config: settings of the source.
        seed: of the run. Validation always uses seed 0, so that runs can be compared.
        validation: use the validation split.

    Raises:
        ValueError: no root, unknown split, or options of a reader for simulated data.
        FileNotFoundError: the data set does not exist.
    """
    split = config.split_name(validation=validation)
    seed = 0 if validation else seed
    if config.source == SIMULATED:
        if config.reader:
            raise ValueError(f"data.reader: has no effect on simulated data, got {config.reader}")
        from cobevglue.simulation.episodes import EpisodeSettings, SimulatedEpisodes

        simulated = SimulatedEpisodes(split, seed, EpisodeSettings(**config.options))
        return Repeated(simulated, config.worlds) if config.worlds is not None and not validation else simulated
    if config.root is None:
        raise ValueError(f"data.root: must be set for the data set {config.source}")
    dataset = open_dataset(config.source, config.root, split, config.reader)
    return DatasetEpisodes(dataset, seed, **config.options)
