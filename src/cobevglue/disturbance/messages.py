"""Disturbances of messages: fabricated boxes, loss and delay."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import numpy as np
from pydantic import Field

from cobevglue.boxes import Boxes
from cobevglue.disturbance.disturbance import Disturbance, ObservedFrame, agent_rng
from cobevglue.messages import MAX_TRACK_ID

if TYPE_CHECKING:
    from cobevglue.perception import PerceptionOutput

__all__ = ["Delay", "FabricatedBoxes", "MessageLoss"]

_FABRICATED_STREAM, _LOSS_STREAM = 71, 72
_CAR = (4.5, 1.9, 1.6)
"""Length, width, height of a fabricated car [m]."""
_GROUND = -1.0
"""Height of its centre if the collaborator has no other box [m]."""
_SCORE = 0.9
_VARIANCE = (0.01, 0.01, 0.001)
"""Of a fabricated box: variance of x, y [m^2] and yaw [rad^2]."""


class FabricatedBoxes(Disturbance):
    """Every collaborator transmits boxes of cars that do not exist.

    They keep their places in its frame and their track ids, so that they are consistent over time. They are added to
    its boxes and detections, not to its points and features.

    Attributes:
        count: number of boxes.
        reach: radius of the disc around the collaborator in which they are uniformly distributed [m].
    """

    count: Annotated[int, Field(ge=0, le=1000)] = 10
    reach: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] = 40.0

    def apply(self, frames: Sequence[ObservedFrame], index: int, ego: str, key: Sequence[int]) -> ObservedFrame:
        """Add the boxes to the observations of collaborators."""
        now = frames[index]
        seen = dict(now.observations)
        for agent in now.collaborators(ego):
            seen[agent] = self._with_more(seen[agent], agent_rng(key, _FABRICATED_STREAM, 0, agent))
        return replace(now, observations=seen)

    def _with_more(self, view: PerceptionOutput, rng: np.random.Generator) -> PerceptionOutput:
        distance, bearing = self.reach * np.sqrt(rng.random(self.count)), rng.uniform(-math.pi, math.pi, self.count)
        z = float(np.median(view.boxes.center[:, 2])) if len(view.boxes) else _GROUND
        more = Boxes(
            center=np.column_stack([distance * np.cos(bearing), distance * np.sin(bearing), np.full(self.count, z)]),
            size=np.tile(_CAR, (self.count, 1)),
            yaw=rng.uniform(-math.pi, math.pi, self.count),
            score=np.full(self.count, _SCORE),
            track_id=MAX_TRACK_ID - np.arange(self.count),
            label=np.full(self.count, "car"),
        )
        detections = Boxes.concatenate([view.detections, more.replace(track_id=None)])
        if detections.score is not None:
            detections = detections[np.argsort(-detections.score, kind="stable")]
        return replace(
            view,
            boxes=Boxes.concatenate([view.boxes, more]),
            variance=np.concatenate([view.variance, np.tile(_VARIANCE, (self.count, 1))]),
            detections=detections,
        )


class MessageLoss(Disturbance):
    """Messages are lost, independently of each other.

    Attributes:
        probability: of the loss of one collaborator's messages of one frame.
    """

    probability: Annotated[float, Field(ge=0.0, le=1.0)] = 0.3

    def apply(self, frames: Sequence[ObservedFrame], index: int, ego: str, key: Sequence[int]) -> ObservedFrame:
        """Remove the collaborators whose messages are lost."""
        now = frames[index]
        for agent in now.collaborators(ego):
            if agent_rng(key, _LOSS_STREAM, index, agent).random() < self.probability:
                now = now.without(agent)
        return now


class Delay(Disturbance):
    """Messages are late: observations and poses of collaborators are of an earlier frame.

    A collaborator without an observation in that frame, or before the first message arrives, is removed.

    Attributes:
        seconds: the delay [s].
    """

    seconds: Annotated[float, Field(ge=0.0, le=1.0)] = 0.2

    def apply(self, frames: Sequence[ObservedFrame], index: int, ego: str, key: Sequence[int]) -> ObservedFrame:
        """Replace the observations and poses of collaborators by earlier ones."""
        now = frames[index]
        sent = [frame for frame in frames[: index + 1] if frame.time <= now.time - self.seconds + 1e-6]
        then = sent[-1] if sent else None
        seen, claimed, true = dict(now.observations), dict(now.claimed), dict(now.true)
        for agent in now.collaborators(ego):
            if then is None or agent not in then.observations:
                del seen[agent], claimed[agent], true[agent]
            else:
                seen[agent], claimed[agent], true[agent] = (
                    then.observations[agent],
                    then.claimed[agent],
                    then.true[agent],
                )
        return replace(now, observations=seen, claimed=claimed, true=true)
