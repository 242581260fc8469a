"""The interface of aligners in the system: from all agents' observations to their poses in the ego frame.

Aligners differ in their inputs. Each declares them (`needs`, `accepts`) and receives nothing else: a self-localised
method never has access to a claimed pose.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from cobevglue.alignment.alignment import Aligner, Alignment
from cobevglue.alignment.own_body import known_bodies
from cobevglue.boxes import Boxes
from cobevglue.messages import ObjectMessage, decode, decode_arrays, encode, encode_arrays
from cobevglue.typing import Float32Array, FloatArray

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["GroupAligner", "Need", "Observation", "Pairwise"]

Need = Literal["boxes", "body", "variance", "points", "features", "pose", "time"]
"""Inputs of aligners; fields of `Observation`."""


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """The data of one agent in one frame, in its own LiDAR frame; None where not transmitted.

    Attributes:
        boxes: its tracked objects.
        body: one-row box of its own vehicle.
        variance: (K, 3) of x, y [m^2] and yaw [rad^2] of the K boxes.
        points: (N, 4) x, y, z [m], intensity.
        features: the detector's three maps (C, H, W).
        pose: (4, 4) world_SE3_lidar as claimed by the agent's localisation, possibly noisy or false.
        time: the agent's own time stamp of its boxes, on any clock [s].
    """

    boxes: Boxes | None = None
    body: Boxes | None = None
    variance: FloatArray | None = None
    points: Float32Array | None = None
    features: tuple[Tensor, Tensor, Tensor] | None = None
    pose: FloatArray | None = None
    time: float | None = None


class GroupAligner(ABC):
    """A source of the poses of all other agents in the ego frame. It may keep a state: use one for each ego.

    Attributes:
        needs: the fields of an observation that it uses.
        accepts: further fields that it uses where they are given.
    """

    needs: ClassVar[frozenset[Need]]
    accepts: ClassVar[frozenset[Need]] = frozenset()

    @abstractmethod
    def align_group(
        self, ego: str, observations: Mapping[str, Observation], time: float | None = None
    ) -> dict[str, Alignment]:
        """The poses of all other agents in the ego frame, each accepted or refused.

        Args:
            ego: its name.
            observations: by the agents' names, the ego among them, with the fields that `needs` names and no others.
            time: of the frame [s]; by default 0.1 s after the last.
        """

    def reset(self) -> None:  # noqa: B027  # not abstract: most have no state
        """Forget all frames; does nothing for aligners without a state."""

    def forget(self, agent: str) -> None:  # noqa: B027
        """Forget what is known of one other agent; does nothing for aligners without a state."""

    def select_inputs(self, observation: Observation) -> Observation:
        """The part of an observation that this aligner uses.

        Raises:
            ValueError: a needed field, such as the pose, is missing; names it.
        """
        missing = [name for name in sorted(self.needs) if getattr(observation, name) is None]
        if missing:
            raise ValueError(f"{type(self).__name__} needs {' and '.join(missing)} of every agent, got None")
        return Observation(**{name: getattr(observation, name) for name in self.needs | self.accepts})

    def encode(self, agent: str, observation: Observation, time: float, frame: int) -> dict[str, bytes]:
        """The messages that transmit the inputs of this aligner, by kind.

        Features are not among them: methods that align by them share them for fusion anyway.
        """
        parts = {}
        if observation.boxes is not None:
            boxes = observation.boxes.replace(score=None, label=None)
            parts["boxes"] = encode(ObjectMessage(agent, time, frame, boxes, observation.body))
        for name, dtype in (("variance", np.float32), ("points", np.float32), ("pose", np.float64)):
            values = getattr(observation, name)
            if values is not None:
                parts[name] = encode_arrays({name: values.astype(dtype)})
        return parts

    def decode(self, parts: Mapping[str, bytes], observation: Observation) -> Observation:
        """The observation decoded from messages; fields that are not transmitted come from `observation`."""
        received: dict[str, Any] = {name: decode_arrays(data)[name] for name, data in parts.items() if name != "boxes"}
        if "boxes" in parts:
            message = decode(parts["boxes"])
            received |= {"boxes": message.boxes, "body": message.body}
        return replace(observation, **received)


class Pairwise(GroupAligner):
    """One aligner of boxes for each collaborator."""

    needs = frozenset({"boxes"})
    accepts = frozenset({"body", "time"})

    def __init__(self, make_aligner: Callable[[], Aligner]) -> None:
        """Aligners are made when a collaborator first appears.

        Args:
            make_aligner: makes an aligner for a new collaborator: `BEVGlue` for example.
        """
        self._make = make_aligner
        self._aligners: dict[str, Aligner] = {}

    def align_group(
        self, ego: str, observations: Mapping[str, Observation], time: float | None = None
    ) -> dict[str, Alignment]:
        """Align each collaborator independently."""
        own = observations[ego]
        assert own.boxes is not None
        found = {}
        for name, other in observations.items():
            if name != ego:
                assert other.boxes is not None
                aligner = self._aligners.setdefault(name, self._make())
                known: dict[str, Any] = known_bodies(own.body, other.body)
                if other.time is not None:
                    known["other_time"] = other.time
                found[name] = aligner.align(own.boxes, other.boxes, time, **known)
        return found

    def reset(self) -> None:
        """Forget all collaborators."""
        self._aligners.clear()

    def forget(self, agent: str) -> None:
        """Forget one collaborator."""
        self._aligners.pop(agent, None)
