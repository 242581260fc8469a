"""No collaboration: the ego's own detections."""

from __future__ import annotations

from collections.abc import Sequence

from cobevglue.boxes import Boxes
from cobevglue.fusion.method import FusionMethod, Received
from cobevglue.messages import Arrays
from cobevglue.perception import PerceptionOutput, PointPillars

__all__ = ["NoCollaboration"]


class NoCollaboration(FusionMethod):
    """Detections of the ego alone: the reference for all other methods."""

    def __init__(self, detector: PointPillars) -> None:
        """Take the detector for the common signature; the method has no layers."""

    def message(self, observation: PerceptionOutput) -> Arrays:
        """Nothing."""
        return {}

    def fuse(self, ego: PerceptionOutput, received: Sequence[Received]) -> Boxes:
        """The ego's detections, whatever was received."""
        return ego.detections
