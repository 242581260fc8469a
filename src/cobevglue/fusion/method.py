"""The interface of fusion methods."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

from cobevglue.boxes import Boxes
from cobevglue.messages import Arrays
from cobevglue.perception import PerceptionOutput, PointPillars
from cobevglue.se2 import SE2

__all__ = ["FusionMethod", "Received"]


@dataclass(frozen=True, slots=True, eq=False)
class Received:
    """The message of another agent, and its relative pose.

    Attributes:
        content: the decoded message.
        ego_SE2_other: its pose in the ego frame, from the aligner.
    """

    content: Arrays
    ego_SE2_other: SE2


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
