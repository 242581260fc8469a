"""Perception of one agent: bird's-eye-view features and tracked boxes from a point cloud (equation 1a).

Imports PyTorch; `import cobevglue` does not.
"""

try:
    import torch as _torch  # noqa: F401
except ModuleNotFoundError as error:
    raise ImportError(
        'the detector needs PyTorch, which is not installed: pip install "cobevglue[perception]"'
    ) from error

from cobevglue.perception.anchors import AnchorGrid, Targets, assign_targets
from cobevglue.perception.config import CONFIGS, Anchor, DetectionConfig, PointPillarsConfig
from cobevglue.perception.head import HeadOutput
from cobevglue.perception.loss import DetectionLoss, LossConfig, LossTerms, TargetBatch, collate_targets
from cobevglue.perception.perception import Perception, PerceptionOutput
from cobevglue.perception.point_pillars import PointPillars

__all__ = [
    "CONFIGS",
    "Anchor",
    "AnchorGrid",
    "DetectionConfig",
    "DetectionLoss",
    "HeadOutput",
    "LossConfig",
    "LossTerms",
    "Perception",
    "PerceptionOutput",
    "PointPillars",
    "PointPillarsConfig",
    "TargetBatch",
    "Targets",
    "assign_targets",
    "collate_targets",
]
