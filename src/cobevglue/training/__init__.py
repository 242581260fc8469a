"""Training in three stages: the detector, its heading refinement, then each fusion method.

    from cobevglue.training import load_config, train_detector
    train_detector(load_config("compact", ["optimisation.epochs=3"]), Path("runs/first"))
    train_heading(load_heading_config("compact", ["detector=runs/first/last.safetensors"]), Path("runs/heading"))
    train_fusion(load_fusion_config("coalign"), Path("runs/coalign"))

`torchrun --nproc-per-node 2 -m cobevglue train detector` trains in two processes.
"""

from cobevglue.training.augmentation import AugmentationConfig, augment
from cobevglue.training.config import PRESETS, DataConfig, TrainDetectorConfig, ValidationConfig, load_config
from cobevglue.training.detector import TrainingResult, train_detector
from cobevglue.training.fusion import FUSION_PRESETS, TrainFusionConfig, load_fusion_config, train_fusion
from cobevglue.training.fusion_features import FeatureConfig
from cobevglue.training.heading import HEADING_PRESETS, TrainHeadingConfig, load_heading_config, train_heading
from cobevglue.training.optimisation import OptimisationConfig
from cobevglue.training.progress import DivergedError
from cobevglue.training.samples import DatasetEpisodes, EpisodeSource

__all__ = [
    "FUSION_PRESETS",
    "HEADING_PRESETS",
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
    "TrainHeadingConfig",
    "TrainingResult",
    "ValidationConfig",
    "augment",
    "load_config",
    "load_fusion_config",
    "load_heading_config",
    "train_detector",
    "train_fusion",
    "train_heading",
]
