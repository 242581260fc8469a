"""Training: samples, augmentation, and the stages (so far: the detector).

    from cobevglue.training import load_config, train_detector
    train_detector(load_config("compact", ["optimisation.epochs=3"]), Path("runs/first"))

`torchrun --nproc-per-node 2 -m cobevglue train detector` trains in two processes.
"""

from cobevglue.training.augmentation import AugmentationConfig, augment
from cobevglue.training.config import PRESETS, DataConfig, TrainDetectorConfig, ValidationConfig, load_config
from cobevglue.training.detector import DivergedError, TrainingResult, train_detector
from cobevglue.training.optimisation import OptimisationConfig
from cobevglue.training.samples import DatasetEpisodes, EpisodeSource

__all__ = [
    "PRESETS",
    "AugmentationConfig",
    "DataConfig",
    "DatasetEpisodes",
    "DivergedError",
    "EpisodeSource",
    "OptimisationConfig",
    "TrainDetectorConfig",
    "TrainingResult",
    "ValidationConfig",
    "augment",
    "load_config",
    "train_detector",
]
