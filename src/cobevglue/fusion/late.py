"""Late fusion: agents share the boxes they detected."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.fusion.method import FusionMethod, Received
from cobevglue.iou import nms
from cobevglue.messages import Arrays
from cobevglue.perception import PerceptionOutput, PointPillars

__all__ = ["LateFusion"]


class LateFusion(FusionMethod):
    """All agents' boxes in the ego's frame, and of those that overlap the one with the best score."""

    kind = "boxes"

    def __init__(self, detector: PointPillars) -> None:
        self.detection = detector.detection

    def message(self, observation: PerceptionOutput) -> Arrays:
        """(K, 8) float32: x, y, z, l, w, h [m], yaw [rad] in the sender's LiDAR frame, and score."""
        boxes = observation.detections
        assert boxes.score is not None
        rows = np.column_stack([boxes.center, boxes.size, boxes.yaw, boxes.score])
        return {"detections": rows.astype(np.float32)}

    def fuse(self, ego: PerceptionOutput, received: Sequence[Received]) -> Boxes:
        """Everyone's boxes after non-maximum suppression, best first."""
        parts = [ego.detections.replace(label=None)]
        for other in received:
            rows = other.content["detections"].astype(np.float64)
            boxes = Boxes(rows[:, :3], rows[:, 3:6], rows[:, 6], rows[:, 7])
            parts.append(other.boxes_at_ego_instant(boxes))
        boxes = Boxes.concatenate(parts)
        return boxes[nms(boxes, self.detection.nms_iou)] if len(boxes) else boxes
