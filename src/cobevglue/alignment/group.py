"""Sources of relative poses as the whole system sees them: from all agents' observations to the ego's view of each.

Aligners differ in what they look at. Each says so (`needs`), and is given nothing else: one that localises by itself
never holds a pose that somebody claimed.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np

from cobevglue.alignment.alignment import Aligner, Alignment
from cobevglue.boxes import Boxes
from cobevglue.messages import ObjectMessage, decode, decode_arrays, encode, encode_arrays
from cobevglue.typing import Float32Array, FloatArray

if TYPE_CHECKING:
    from torch import Tensor

__all__ = ["GroupAligner", "Need", "Observation", "Pairwise"]

Need = Literal["boxes", "body", "variance", "points", "features", "pose"]
"""What an aligner may look at; fields of `Observation`."""


@dataclass(frozen=True, slots=True, eq=False)
class Observation:
    """What one agent has to tell in one frame; all in its own LiDAR frame. None is what was not told.

    Attributes:
        boxes: its tracked objects.
        body: one-row box of its own vehicle.
        variance: (K, 3) of x, y [m^2] and yaw [rad^2] of the K boxes.
        points: (N, 4) x, y, z [m], intensity.
        features: the detector's three maps (C, H, W).
        pose: (4, 4) world_SE3_lidar as the agent claims it, from whatever localisation: noisy, or a lie.
    """

    boxes: Boxes | None = None
    body: Boxes | None = None
    variance: FloatArray | None = None
    points: Float32Array | None = None
    features: tuple[Tensor, Tensor, Tensor] | None = None
    pose: FloatArray | None = None


class GroupAligner(ABC):
    """A source of the poses of all other agents in the ego's frame. It may remember; one is needed for each ego.

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
        """The poses of all agents but the ego in the ego's frame, each accepted or refused.

        Args:
            ego: its name.
            observations: by the agents' names, the ego among them, with the fields that `needs` names and no others.
            time: of the frame [s]; by default 0.1 s after the last.
        """

    def reset(self) -> None:  # noqa: B027  # not abstract: most remember nothing
        """Forget everything seen so far; nothing to do for those that remember nothing."""

    def select_inputs(self, observation: Observation) -> Observation:
        """The part of an observation that this aligner is given.

        Raises:
            ValueError: it lacks something that is needed, such as a pose; says what.
        """
        missing = [name for name in sorted(self.needs) if getattr(observation, name) is None]
        if missing:
            raise ValueError(f"{type(self).__name__} needs {' and '.join(missing)} of every agent, got None")
        return Observation(**{name: getattr(observation, name) for name in self.needs | self.accepts})

    def encode(self, agent: str, observation: Observation, time: float, frame: int) -> dict[str, bytes]:
        """The messages by which an agent tells the others what this aligner needs of it, by kind.

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
        """What the ego reads in the messages of another agent (`observation` has what does not travel by itself)."""
        received: dict[str, Any] = {name: decode_arrays(data)[name] for name, data in parts.items() if name != "boxes"}
        if "boxes" in parts:
            message = decode(parts["boxes"])
            received |= {"boxes": message.boxes, "body": message.body}
        return replace(observation, **received)


class Pairwise(GroupAligner):
    """One aligner of boxes for each collaborator, which it remembers."""

    needs = frozenset({"boxes"})
    accepts = frozenset({"body"})

    def __init__(self, make_aligner: Callable[[], Aligner]) -> None:
        """Nothing is made before a collaborator is first met.

        Args:
            make_aligner: makes an aligner for a new collaborator: `BEVGlue` for example.
        """
        self._make = make_aligner
        self._aligners: dict[str, Aligner] = {}

    def align_group(
        self, ego: str, observations: Mapping[str, Observation], time: float | None = None
    ) -> dict[str, Alignment]:
        """Each collaborator by itself."""
        own = observations[ego]
        assert own.boxes is not None
        found = {}
        for name, other in observations.items():
            if name != ego:
                assert other.boxes is not None
                aligner = self._aligners.setdefault(name, self._make())
                bodies = {"ego_body": own.body, "other_body": other.body}
                found[name] = aligner.align(own.boxes, other.boxes, time, **bodies)
        return found

    def reset(self) -> None:
        """Forget all collaborators."""
        self._aligners.clear()
