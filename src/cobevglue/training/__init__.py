"""Training: samples, augmentation, and the stages: the detector, then each fusion method on its features.

    from cobevglue.training import load_config, train_detector
    train_detector(load_config("compact", ["optimisation.epochs=3"]), Path("runs/first"))
    train_fusion(load_fusion_config("coalign"), Path("runs/coalign"))

`torchrun --nproc-per-node 2 -m cobevglue train detector` trains in two processes.
"""

from cobevglue.training.augmentation import AugmentationConfig, augment
from cobevglue.training.config import PRESETS, DataConfig, TrainDetectorConfig, ValidationConfig, load_config
from cobevglue.training.detector import DivergedError, TrainingResult, train_detector
from cobevglue.training.fusion import FUSION_PRESETS, TrainFusionConfig, load_fusion_config, train_fusion
from cobevglue.training.fusion_features import FeatureConfig
from cobevglue.training.optimisation import OptimisationConfig
from cobevglue.training.samples import DatasetEpisodes, EpisodeSource

__all__ = [
    "FUSION_PRESETS",
    "PRESETS",
    "AugmentationConfig",
    "DataConfig",
    "DatasetEpisodes",
    "DivergedError",
    "EpisodeSource",
    "FeatureConfig",
    "OptimisationConfig",
    "TrainDetectorConfig",
    "TrainFusionConfig",
    "TrainingResult",
    "ValidationConfig",
    "augment",
    "load_config",
    "load_fusion_config",
    "train_detector",
    "train_fusion",
]
