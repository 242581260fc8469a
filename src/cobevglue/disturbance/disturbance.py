"""The interface of disturbances, which change what an ego receives in one frame of a sequence."""

from __future__ import annotations

import zlib
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.settings import Settings
from cobevglue.typing import FloatArray

if TYPE_CHECKING:
    from cobevglue.perception import PerceptionOutput

__all__ = ["Disturbance", "ObservedFrame", "Undisturbed", "agent_rng"]


@dataclass(frozen=True, slots=True, eq=False)
class ObservedFrame:
    """Observations and poses of all agents in one frame; three mappings from the agents' names.

    Attributes:
        time: when the messages are sent [s].
        observations: the output of each agent's perception.
        claimed: (4, 4) world_SE3_lidar from each agent's localisation.
        true: (4, 4) world_SE3_lidar of each agent at the time of its observation; for the evaluation only.
        own_vehicles: one-row box of the vehicle of each agent that has one, in its LiDAR frame.
    """

    time: float
    observations: Mapping[str, PerceptionOutput]
    claimed: Mapping[str, FloatArray]
    true: Mapping[str, FloatArray]
    own_vehicles: Mapping[str, Boxes] = field(default_factory=dict)

    def without(self, agent: str) -> ObservedFrame:
        """The frame without this agent."""
        return replace(
            self,
            observations=_without(self.observations, agent),
            claimed=_without(self.claimed, agent),
            true=_without(self.true, agent),
        )

    def collaborators(self, ego: str) -> list[str]:
        """All agents but the ego."""
        return [agent for agent in self.observations if agent != ego]


class Disturbance(Settings):
    """A disturbance of localisation or communication. The same key gives the same disturbance in any process."""

    @abstractmethod
    def apply(self, frames: Sequence[ObservedFrame], index: int, ego: str, key: Sequence[int]) -> ObservedFrame:
        """What the ego receives in place of `frames[index]`.

        Args:
            frames: the undisturbed sequence from its beginning. Observations older than one second may be missing;
                poses are complete.
            index: the current frame.
            ego: name of the receiver. Its own observations are never changed.
            key: whole numbers >= 0, such as the seed and the number of the sequence; random numbers come from
                `np.random.default_rng([*key, stream, index, agent])`.
        """


class Undisturbed(Disturbance):
    """No disturbance."""

    def apply(self, frames: Sequence[ObservedFrame], index: int, ego: str, key: Sequence[int]) -> ObservedFrame:
        """The frame itself."""
        return frames[index]


def agent_rng(key: Sequence[int], stream: int, index: int, agent: str) -> np.random.Generator:
    """Random numbers of one agent in one frame, independent of the other agents."""
    return np.random.default_rng([*key, stream, index, zlib.crc32(agent.encode())])


_Value = TypeVar("_Value")


def _without(table: Mapping[str, _Value], agent: str) -> dict[str, _Value]:
    return {name: value for name, value in table.items() if name != agent}
