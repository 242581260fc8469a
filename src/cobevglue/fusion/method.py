"""What every way of putting together what several agents saw looks like from outside."""

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
    """What came from another agent, and where that agent is.

    Attributes:
        content: what it sent.
        ego_SE2_other: its pose in the ego's frame, whoever found it out.
    """

    content: Arrays
    ego_SE2_other: SE2


class FusionMethod(ABC):
    """Equations (1c) to (1e) of CoBEVGlue: from what all agents saw to the boxes of the ego.

    A method says what an agent sends to others (`message`), and what the ego makes of what it saw itself and of what it
    received (`fuse`). Nobody to hear from is no special case: then `fuse` has only what the ego saw. Objects are made
    as `Method(detector)`.

    Attributes:
        kind: what a message is made of, as communication is reported by it.
        usual_aligner: the name of the source of poses that its paper has; "given" for the agents' localisation.
    """

    kind: ClassVar[Literal["features", "boxes", "points"]] = "features"
    usual_aligner: ClassVar[str] = "given"

    @abstractmethod
    def __init__(self, detector: PointPillars) -> None:
        """Make the method for what this detector sees; the detector is not changed."""

    @abstractmethod
    def message(self, seen: PerceptionOutput) -> Arrays:
        """What an agent sends to all others in a frame; {} for nothing. All of it is encoded and counted."""

    @abstractmethod
    def fuse(self, ego: PerceptionOutput, received: Sequence[Received]) -> Boxes:
        """What the ego concludes.

        Args:
            ego: what it saw itself.
            received: from the other agents; maybe none.

        Returns:
            Boxes with scores in the ego's LiDAR frame, best first.
        """
