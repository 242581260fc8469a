"""What one agent sees by itself: point cloud in, bird's-eye-view features and tracked boxes out (equation 1a).

The only networks of CoBEVGlue, so this is where PyTorch is imported; `import cobevglue` does without.
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
