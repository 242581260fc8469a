"""Replay of a recording: each list of the ego with the newest lists of the other agents, aligned and fused.

with open_recording("drive.mcap") as recording:
    for frame in Replay(recording, ego="/car1/objects", others=["/car2/objects"]):
        frame.time, frame.seen.alignments["car2"], frame.seen.objects
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from cobevglue.boxes import Boxes
from cobevglue.object_collaboration import FusedObjects, ObjectCollaboration
from cobevglue.recordings import Recording
from cobevglue.replay.sources import Source, is_elsewhere, make_source
from cobevglue.replay.stream import AgentStream, Arrival
from cobevglue.replay.topics import CLOUDS, OBJECTS, agent_topics
from cobevglue.replay.transforms import Transforms, transform_topics

if TYPE_CHECKING:
    from cobevglue.perception import PointPillars

__all__ = ["Replay", "ReplayFrame"]


@dataclass(frozen=True, slots=True, eq=False)
class ReplayFrame:
    """One list of the ego, with what came of it.

    Attributes:
        index: 0, 1, 2, …
        time: time stamp of the ego's list [s].
        received: time of its receipt [s].
        stamps: time stamps of all lists by agent, each of its agent's clock [s].
        ages: by other agent, how much earlier than the ego's its list was received [s].
        seen: alignments, fused objects and tracked lists.
    """

    index: int
    time: float
    received: float
    stamps: dict[str, float]
    ages: dict[str, float]
    seen: FusedObjects


@dataclass(frozen=True, slots=True, eq=False)
class _List:
    stamp: float
    received: float
    boxes: Boxes
    body: Boxes | None


class Replay:
    """The frames of a recording, in order.

    Args:
        recording: an open one.
        ego: topic of the agent in whose frame the results are; guessed if left out.
        others: topics of the other agents; guessed if left out.
        max_age: lists that were received earlier before the ego's are not used [s].
        bodies: one-row box of the own vehicle of agents that know it, by agent, in their own frame.
        frames: by agent, the frame into which its object lists are brought by the recorded transforms. By default they
            are left where they are; those in a map are brought into `base_link`.
        detector: for topics with point clouds; the shipped one by default.

    Attributes:
        ego: name of the ego.
        topics: by agent, the ego's first.
        streams: what came in, by agent; those of stations that send messages are added as they come.

    Raises:
        ValueError: a topic is not there or has no objects; names those there.
        ModuleNotFoundError: point clouds need torch.
    """

    def __init__(
        self,
        recording: Recording,
        ego: str | None = None,
        others: Sequence[str] = (),
        *,
        max_age: float = 0.5,
        bodies: dict[str, Boxes] | None = None,
        frames: dict[str, str] | None = None,
        detector: PointPillars | None = None,
    ) -> None:
        if not max_age > 0.0:
            raise ValueError(f"max_age must be > 0, got {max_age}")
        self.recording, self.max_age, self.bodies = recording, max_age, bodies or {}
        self.topics = agent_topics(recording, ego, others)
        self.ego = next(iter(self.topics))
        if detector is None and any(topic.type in CLOUDS for topic in self.topics.values()):
            detector = _shipped_detector()
        self.frames = frames or {}
        self._detector = detector
        self.streams: dict[str, AgentStream] = {}

    def __iter__(self) -> Iterator[ReplayFrame]:
        """Read the recording.

        Raises:
            ValueError: the recording is damaged, or a message has a bad value; names topic and message.
        """
        collaboration = ObjectCollaboration()
        newest: dict[str, _List] = {}
        self.streams.clear()
        index = 0
        for agent, entry, is_restart in self._lists():
            if is_restart and agent == self.ego:
                collaboration.reset()
                newest.clear()
            elif is_restart:
                collaboration.forget(agent)
            newest[agent] = entry
            if agent == self.ego:
                yield self._frame(index, newest, collaboration)
                index += 1

    def _frame(self, index: int, newest: dict[str, _List], collaboration: ObjectCollaboration) -> ReplayFrame:
        own = newest[self.ego]
        used = {agent: entry for agent, entry in newest.items() if own.received - entry.received <= self.max_age}
        stamps = {agent: entry.stamp for agent, entry in used.items()}
        bodies = {agent: entry.body for agent, entry in used.items() if entry.body is not None}
        seen = collaboration.step(
            {agent: entry.boxes for agent, entry in used.items()},
            self.ego,
            own.stamp,
            stamps,
            {agent: body for agent, body in {**bodies, **self.bodies}.items() if agent in used},
        )
        ages = {agent: own.received - entry.received for agent, entry in used.items() if agent != self.ego}
        return ReplayFrame(index, own.stamp, own.received, stamps, ages, seen)

    def _lists(self) -> Iterator[tuple[str, _List, bool]]:
        """Agent, list, and whether everything before it is to be forgotten, in the order of receipt."""
        sources, trees = self._make_sources()
        counts = dict.fromkeys(sources, 0)
        for topic, received, message in self.recording.messages([*sources, *trees]):
            if topic in trees:
                for tree in trees[topic]:
                    tree.add(message)
                continue
            counts[topic] += 1
            source = sources[topic]
            try:
                agent, stamp = source.sender(message)
                stream = self._stream(agent, topic)
                if stamp == 0.0:
                    stamp = received
                    stream.unstamped += 1
                arrival = stream.arrive(stamp)
                if arrival is Arrival.DROP:
                    continue
                content = source.content(message, stamp)
            except ValueError as error:
                where = f"{self.recording.path}: {topic}: message {counts[topic]}"
                raise ValueError(f"{where} (received at {received:.3f} s): {error}") from None
            stream.without_size += content.without_size
            stream.new_identities += content.new_identities
            restart = arrival is Arrival.RESTART or content.new_identities
            yield agent, _List(stamp, received, content.boxes, content.body), restart

    def _make_sources(self) -> tuple[dict[str, Source], dict[str, list[Transforms]]]:
        """The sources by topic; by topic with transforms, the trees that need them."""
        sources: dict[str, Source] = {}
        trees: dict[str, list[Transforms]] = {}
        types = {name: topic.type for name, topic in self.recording.topics.items()}
        for agent, topic in self.topics.items():
            own_frame, tree = self.frames.get(agent), None
            if topic.type in OBJECTS and self._is_elsewhere(topic.name, own_frame):
                of_agent = transform_topics(topic.name, types)
                if of_agent:
                    tree = Transforms()
                    for name in of_agent:
                        trees.setdefault(name, []).append(tree)
            sources[topic.name] = make_source(agent, topic, self._detector, own_frame, tree)
        return sources, trees

    def _is_elsewhere(self, topic: str, own_frame: str | None) -> bool:
        """Whether the first list of a topic has to be brought into the agent's own frame."""
        first = next(self.recording.messages([topic]), None)
        return first is not None and is_elsewhere(str(first[2].header.frame_id), own_frame)

    def _stream(self, agent: str, topic: str) -> AgentStream:
        stream = self.streams.setdefault(agent, AgentStream(topic))
        if stream.topic != topic:
            raise ValueError(f"agent {agent!r} is on {stream.topic}, too; each agent has a topic and an id of its own")
        return stream


def _shipped_detector() -> PointPillars:
    try:
        from cobevglue.perception import PointPillars
    except ImportError as error:
        raise ModuleNotFoundError(f"point clouds: {error}", name="torch") from None
    return PointPillars.pretrained("compact")
