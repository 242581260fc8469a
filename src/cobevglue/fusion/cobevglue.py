"""CoBEVGlue's fusion: the maximum over agents at each of three scales, and the boxes of all agents merged with it."""

from __future__ import annotations

from collections.abc import Sequence

from torch import Tensor

from cobevglue.box_merging import merge_boxes
from cobevglue.boxes import Boxes
from cobevglue.fusion.intermediate import MultiScaleFusion
from cobevglue.fusion.late import detection_rows, received_detections
from cobevglue.fusion.method import Received
from cobevglue.messages import Arrays
from cobevglue.perception import PerceptionOutput

__all__ = ["MaxFusion", "MaxFusionWithBoxes"]

_FUSED, _EGO, _OTHER = 0.95, 0.9, 0.7
"""Reliabilities of boxes from the fused features, the ego's and other agents' (validation split, benchmarks.md)."""


class MaxFusion(MultiScaleFusion):
    """Equation (1d) of CoBEVGlue: element-wise maximum at strides 2, 4 and 8, without parameters.

    The paper says nothing of noise in training. Ours makes relative poses as wrong as BEVGlue's are on drives of the
    simulated validation split: 0.1 m in x and y, 0.3 degrees.
    """

    usual_aligner = "bevglue"
    training_noise = (0.07, 0.2)

    def fuse_maps(self, maps: Sequence[Tensor], covered: Sequence[Tensor]) -> list[Tensor]:
        """The maximum over agents."""
        return [m.amax(dim=0) for m in maps]


class MaxFusionWithBoxes(MaxFusion):
    """The maximum over agents, whose boxes are then merged with the boxes that each agent detected alone; ours.

    An agent's box is more precise than what the fused features say of an object that this agent alone observes:
    features lose precision by warping. Boxes of other agents that nothing else confirms get a lower score, so that
    invented ones do less harm. The weights are those of `MaxFusion`.
    """

    def message(self, observation: PerceptionOutput) -> Arrays:
        """The shared maps, and the agent's detections."""
        return {**super().message(observation), "detections": detection_rows(observation)}

    def fuse(self, ego: PerceptionOutput, received: Sequence[Received]) -> Boxes:
        """The boxes decoded from the fused maps, merged with those of each agent."""
        fused = super().fuse(ego, received)
        if not received:
            return fused
        others = [received_detections(other) for other in received]
        return merge_boxes([fused, ego.detections, *others], [_FUSED, _EGO, *[_OTHER] * len(others)])

    @classmethod
    def architecture(cls) -> str:
        """That of `MaxFusion`."""
        return MaxFusion.architecture()
