"""Which topic is which agent's: as named by the user, or guessed from the names and types of the topics."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Sequence

from cobevglue.recordings import Recording, Topic

__all__ = ["CLOUDS", "MESSAGES", "OBJECTS", "agent_topics"]

_AUTOWARE = ("autoware_perception_msgs", "autoware_auto_perception_msgs")
OBJECTS = (
    "vision_msgs/msg/Detection3DArray",
    *(f"{package}/msg/{name}" for package in _AUTOWARE for name in ("DetectedObjects", "TrackedObjects")),
)
"""Types with objects."""
CLOUDS = ("sensor_msgs/msg/PointCloud2",)
"""Types with point clouds."""
MESSAGES = ("std_msgs/msg/UInt8MultiArray", "udp_msgs/msg/UdpPacket")
"""Types whose bytes are CPMs or our own messages. Such a topic may have several senders, and it is never guessed."""


def agent_topics(recording: Recording, ego: str | None = None, others: Sequence[str] = ()) -> dict[str, Topic]:
    """The topics of the agents by the names of the agents, the ego's first.

    Agents are named by the part of the topic in which the topics differ: `/car1/objects` and `/car2/objects` are of
    car1 and car2.

    Args:
        recording: an open one.
        ego: topic of the ego; guessed if left out.
        others: topics of the other agents; guessed if left out.

    Raises:
        ValueError: a topic is not there, comes twice or has no objects, or the topics cannot be guessed; names those
            there.
    """
    if ego is None and others:
        raise ValueError("give the topic of the ego, too (--ego)")
    chosen = [] if ego is None else [_usable(recording, ego)]
    chosen += [_usable(recording, name) for name in others] if others else _guessed(recording, chosen)
    if chosen[0].type in MESSAGES:
        raise ValueError(f"{chosen[0].name}: the ego needs object lists or point clouds, not messages of others")
    for topic in chosen:
        if chosen.count(topic) > 1:
            raise ValueError(f"{topic.name}: given twice; each agent has a topic of its own")
    return dict(zip(_names([topic.name for topic in chosen]), chosen, strict=True))


def _usable(recording: Recording, name: str) -> Topic:
    """The topic of this name, of which the leading slash may be left out."""
    topic = recording.topics.get(name) or recording.topics.get(f"/{name}")
    if topic is None:
        raise ValueError(f"{recording.path}: there is no topic {name!r}; {_listed(recording)}")
    if topic.type not in OBJECTS + CLOUDS + MESSAGES:
        raise ValueError(f"{recording.path}: {topic.name} has {topic.type}, which has no objects; {_listed(recording)}")
    return topic


def _guessed(recording: Recording, ego: list[Topic]) -> list[Topic]:
    """The largest set of topics of one type whose names differ in one part; object lists before point clouds."""
    order = {kind: number for number, kind in enumerate(OBJECTS + CLOUDS)}
    usable = [topic for topic in recording.topics.values() if topic.type in order and topic.count]
    sets: dict[tuple[str, int, tuple[str, ...]], list[Topic]] = defaultdict(list)
    for topic in usable:
        parts = topic.name.split("/")
        for place in range(len(parts)):
            sets[topic.type, place, tuple(parts[:place] + parts[place + 1 :])].append(topic)
    candidates = [
        (topic_set, key) for key, topic_set in sets.items() if len(topic_set) > 1 and all(t in topic_set for t in ego)
    ]
    if candidates:
        best, _ = min(candidates, key=lambda each: (each[1][0] in CLOUDS, -len(each[0]), order[each[1][0]], each[1][1]))
        return [topic for topic in best if topic not in ego]
    lists = [topic for topic in usable if topic.type in OBJECTS]
    if len(lists) == 2 and all(topic in lists for topic in ego):
        return [topic for topic in lists if topic not in ego]
    raise ValueError(f"{recording.path}: name the agents' topics (--ego, --other): {_listed(recording)}")


def _listed(recording: Recording) -> str:
    """The topics with objects; all if there is none."""
    usable = [topic for topic in recording.topics.values() if topic.type in OBJECTS + CLOUDS + MESSAGES]
    if usable:
        return "there are " + ", ".join(f"{topic.name} ({topic.type}, {topic.count})" for topic in usable)
    every = ", ".join(f"{topic.name} ({topic.type})" for topic in recording.topics.values())
    return f"none has objects or point clouds, only {every or 'no topics at all'}"


def _names(topics: list[str]) -> list[str]:
    """The parts in which the topics differ; the whole topic where one would have no name."""
    parts = [topic.strip("/").split("/") for topic in topics]
    while all(len(each) > 1 for each in parts) and len({each[0] for each in parts}) == 1:
        parts = [each[1:] for each in parts]
    while all(len(each) > 1 for each in parts) and len({each[-1] for each in parts}) == 1:
        parts = [each[:-1] for each in parts]
    return ["/".join(each) for each in parts]
