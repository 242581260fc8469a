"""What every disturbance looks like from outside: it changes what an ego hears in one moment of a drive."""

from __future__ import annotations

import zlib
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from cobevglue.settings import Settings
from cobevglue.typing import FloatArray

if TYPE_CHECKING:
    from cobevglue.perception import PerceptionOutput

__all__ = ["Disturbance", "Moment", "Undisturbed", "agent_rng"]


@dataclass(frozen=True, slots=True, eq=False)
class Moment:
    """What all agents tell at one time; three tables by the agents' names.

    Attributes:
        time: when it is told [s].
        seen: what each agent saw.
        claimed: (4, 4) world_SE3_lidar as each agent's localisation has it.
        true: (4, 4) world_SE3_lidar of each agent when it saw this; nobody but the evaluation looks at it.
    """

    time: float
    seen: Mapping[str, PerceptionOutput]
    claimed: Mapping[str, FloatArray]
    true: Mapping[str, FloatArray]

    def without(self, agent: str) -> Moment:
        """The same, but nothing of this agent."""
        return replace(
            self,
            seen=_without(self.seen, agent),
            claimed=_without(self.claimed, agent),
            true=_without(self.true, agent),
        )

    def collaborators(self, ego: str) -> list[str]:
        """All agents but the ego."""
        return [agent for agent in self.seen if agent != ego]


class Disturbance(Settings):
    """Something that goes wrong between the agents. The same key gives the same disturbance, in any process."""

    @abstractmethod
    def apply(self, moments: Sequence[Moment], index: int, ego: str, key: Sequence[int]) -> Moment:
        """What is heard in place of `moments[index]`.

        Args:
            moments: a drive from its beginning, undisturbed. Of moments that are more than a second old only the poses
                may be there.
            index: which one is heard.
            ego: who hears it. What the ego saw itself is never changed.
            key: whole numbers >= 0, such as the seed and the number of the drive; random numbers come from
                `np.random.default_rng([*key, stream, index, agent])`.
        """


class Undisturbed(Disturbance):
    """Everything as it is."""

    def apply(self, moments: Sequence[Moment], index: int, ego: str, key: Sequence[int]) -> Moment:
        """The moment itself."""
        return moments[index]


def agent_rng(key: Sequence[int], stream: int, index: int, agent: str) -> np.random.Generator:
    """Random numbers of one agent in one moment, whichever others are there."""
    return np.random.default_rng([*key, stream, index, zlib.crc32(agent.encode())])


_Value = TypeVar("_Value")


def _without(table: Mapping[str, _Value], agent: str) -> dict[str, _Value]:
    return {name: value for name, value in table.items() if name != agent}
