"""Nodes that hear each other without a network, in a simulated junction."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from functools import cache

import numpy as np

from cobevglue.node import NodeCore, NodeResult, NodeSettings, Outgoing, OwnList
from cobevglue.simulation import Junction, JunctionSettings, ObjectListFrame

Channel = Callable[[Outgoing], Iterable[tuple[bytes, bytes | None]]]
"""From what was sent to what arrives now."""


def perfect(sent: Outgoing) -> Iterable[tuple[bytes, bytes | None]]:
    """Everything arrives, once and at once."""
    return [(sent.data, sent.header)]


@cache
def frames(agents: int = 2, duration: float = 8.0) -> list[ObjectListFrame]:
    """The junction."""
    return list(Junction(seed=3, settings=JunctionSettings(agents=agents, duration=duration)))


def own_list(frame: ObjectListFrame, agent: str, time: float) -> OwnList:
    """What the agent sees, with another time stamp."""
    view = frame.agents[agent]
    return OwnList(view.boxes, time, view.body)


class Drive:
    """The ego car1 and one sender, car2; frame after frame, at 10 Hz, on the ego's clock."""

    def __init__(self, settings: NodeSettings | None = None) -> None:
        self.ego = NodeCore("car1", 1, settings)
        self.other = NodeCore("car2", 1000)
        self.sent: list[Outgoing] = []
        self.refused: list[str] = []
        self.step = 0
        self.clock_difference = 0.0

    @property
    def now(self) -> float:
        """Time on the ego's clock [s]."""
        return 50.0 + 0.1 * self.step

    def frame(self, channel: Channel = perfect) -> NodeResult:
        """One frame: the other sends, what arrives is received, the ego aligns."""
        frame = frames()[self.step % len(frames())]
        sent = self.other.observe(own_list(frame, "car2", self.now + self.clock_difference), self.now)
        self.sent.append(sent)
        for data, header in channel(sent):
            self.refused.append(self.ego.receive(data, self.now, header))
        return self.alone()

    def alone(self) -> NodeResult:
        """One frame of the ego only."""
        frame = frames()[self.step % len(frames())]
        self.ego.observe(own_list(frame, "car1", self.now), self.now)
        result = self.ego.align(self.now)
        assert result is not None
        self.step += 1
        return result

    def run(self, number: int, channel: Channel = perfect) -> NodeResult:
        """So many frames; the last result."""
        for _ in range(number):
            result = self.frame(channel)
        return result

    def error(self, result: NodeResult) -> float:
        """Distance of the other's pose from the truth [m]."""
        pose = result.alignments["car2"].ego_SE2_other
        assert pose is not None, result.alignments["car2"].reason
        truth = frames()[(self.step - 1) % len(frames())].ego_SE2_other("car1", "car2")
        return float(np.hypot(pose.x - truth.x, pose.y - truth.y))
