"""The interface of fusion methods."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import numpy as np

from cobevglue.alignment.alignment import Alignment
from cobevglue.boxes import Boxes
from cobevglue.messages import Arrays
from cobevglue.perception import PerceptionOutput, PointPillars
from cobevglue.se2 import SE2

__all__ = ["FusionMethod", "Received"]

_SAME_BOX = 2.0
"""Distance within which a detected box and an aligned one are of one object [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class Received:
    """The message of another agent, and its relative pose.

    Attributes:
        content: the decoded message.
        ego_SE2_other: its pose in the ego frame at the instant of its message, from the aligner: for features, points
            and what stands still.
        alignment: of the aligner; None for a message of the ego's instant.
        aligned: the N boxes that were aligned, in the other's frame, whose velocities the alignment has.
    """

    content: Arrays
    ego_SE2_other: SE2
    alignment: Alignment | None = None
    aligned: Boxes | None = None

    def boxes_at_ego_instant(self, boxes: Boxes) -> Boxes:
        """Boxes of the other agent in the ego frame at the ego's instant.

        Each moves with the aligned box that it lies on; without one it is taken for standing still.

        Args:
            boxes: K boxes in the other's frame at the instant of its message.
        """
        still = boxes.transform(self.ego_SE2_other)
        if self.alignment is None or self.aligned is None or self.alignment.ego_SE2_other is None:
            return still
        velocity = self.alignment.other_velocity
        if velocity is None or not len(boxes) or not len(self.aligned):
            return still
        gap = np.linalg.norm(boxes.center[:, None, :2] - self.aligned.center[None, :, :2], axis=-1)
        nearest = gap.argmin(axis=1)
        moved = replace(self.alignment, other_velocity=velocity[nearest]).boxes_at_ego_instant(boxes)
        tracked = gap[np.arange(len(boxes)), nearest] < _SAME_BOX
        return still.replace(
            center=np.where(tracked[:, None], moved.center, still.center), yaw=np.where(tracked, moved.yaw, still.yaw)
        )


class FusionMethod(ABC):
    """Equations (1c) to (1e) of CoBEVGlue: from the observations of all agents to the ego's boxes.

    A method defines the message of an agent (`message`), and the fusion of the ego's observation with the received
    messages (`fuse`), of which there may be none. Instances are made as `Method(detector)`.

    Attributes:
        kind: of data in a message, by which communication volume is reported.
        usual_aligner: name of the aligner of the method's paper; "given" for the agents' localisation.
    """

    kind: ClassVar[Literal["features", "boxes", "points"]] = "features"
    usual_aligner: ClassVar[str] = "given"

    @abstractmethod
    def __init__(self, detector: PointPillars) -> None:
        """Make the method for the outputs of this detector, which is not changed."""

    @abstractmethod
    def message(self, observation: PerceptionOutput) -> Arrays:
        """The message that an agent broadcasts in a frame; {} for none. All of it is encoded and counted."""

    @abstractmethod
    def fuse(self, ego: PerceptionOutput, received: Sequence[Received]) -> Boxes:
        """Fuse the ego's observation with the received messages.

        Args:
            ego: its own observation.
            received: messages of the other agents; may be empty.

        Returns:
            Boxes with scores in the ego's LiDAR frame, best first.
        """
