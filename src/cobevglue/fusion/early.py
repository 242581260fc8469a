"""Early fusion: agents share their points."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.fusion.method import FusionMethod, Received
from cobevglue.messages import Arrays
from cobevglue.perception import PerceptionOutput, PointPillars
from cobevglue.typing import Float32Array

__all__ = ["EarlyFusion", "merge_points"]


class EarlyFusion(FusionMethod):
    """One detector on all agents' points together."""

    kind = "points"

    def __init__(self, detector: PointPillars) -> None:
        self.detector = detector

    def message(self, observation: PerceptionOutput) -> Arrays:
        """(N, 4) float32: x, y, z [m] in the sender's LiDAR frame, and intensity."""
        return {"points": observation.points}

    def fuse(self, ego: PerceptionOutput, received: Sequence[Received]) -> Boxes:
        """What the detector finds in the merged cloud."""
        if not received:
            return ego.detections
        return self.detector.detect(merge_points(ego.points, received))


def merge_points(ego: Float32Array, received: Sequence[Received]) -> Float32Array:
    """(N, 4) the ego's points and those that were received, all in the ego's LiDAR frame."""
    parts = [ego]
    for other in received:
        points = other.content["points"]
        moved = np.column_stack([other.ego_SE2_other.apply(points[:, :3]), points[:, 3]])
        parts.append(moved.astype(np.float32))
    return np.concatenate(parts)
