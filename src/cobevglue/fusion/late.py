"""Late fusion: agents share the boxes they detected."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.fusion.method import FusionMethod, Received
from cobevglue.iou import nms
from cobevglue.messages import Arrays
from cobevglue.perception import PerceptionOutput, PointPillars
from cobevglue.typing import Float32Array

__all__ = ["LateFusion", "detection_rows", "received_detections"]


class LateFusion(FusionMethod):
    """All agents' boxes in the ego frame, and of those that overlap the one with the best score."""

    kind = "boxes"

    def __init__(self, detector: PointPillars) -> None:
        self.detection = detector.detection

    def message(self, observation: PerceptionOutput) -> Arrays:
        """The agent's detections."""
        return {"detections": detection_rows(observation)}

    def fuse(self, ego: PerceptionOutput, received: Sequence[Received]) -> Boxes:
        """All agents' boxes after non-maximum suppression, best first."""
        boxes = Boxes.concatenate([ego.detections.replace(label=None), *map(received_detections, received)])
        return boxes[nms(boxes, self.detection.nms_iou)] if len(boxes) else boxes


def detection_rows(observation: PerceptionOutput) -> Float32Array:
    """(K, 8) x, y, z, l, w, h [m], yaw [rad] in the agent's LiDAR frame, and score, of its detections."""
    boxes = observation.detections
    assert boxes.score is not None
    return np.column_stack([boxes.center, boxes.size, boxes.yaw, boxes.score]).astype(np.float32)


def received_detections(other: Received) -> Boxes:
    """The `detections` of a message, in the ego frame at the ego's instant."""
    rows = other.content["detections"].astype(np.float64)
    return other.boxes_at_ego_instant(Boxes(rows[:, :3], rows[:, 3:6], rows[:, 6], rows[:, 7]))
