"""No collaboration: the ego's own detections."""

from __future__ import annotations

from collections.abc import Sequence

from cobevglue.boxes import Boxes
from cobevglue.fusion.method import FusionMethod, Received
from cobevglue.messages import Arrays
from cobevglue.perception import PerceptionOutput, PointPillars

__all__ = ["NoCollaboration"]


class NoCollaboration(FusionMethod):
    """What a single agent sees: the row that collaboration has to beat."""

    def __init__(self, detector: PointPillars) -> None:
        """The detector has done all there is to do."""

    def message(self, observation: PerceptionOutput) -> Arrays:
        """Nothing."""
        return {}

    def fuse(self, ego: PerceptionOutput, received: Sequence[Received]) -> Boxes:
        """The ego's detections, whatever was received."""
        return ego.detections
