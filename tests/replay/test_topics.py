"""Which topic is whose: named, guessed, or an error that lists those there."""

from __future__ import annotations

from pathlib import Path

import pytest

pytest.importorskip("rosbags", reason="recordings need rosbags")

from cobevglue.recordings import open_recording
from cobevglue.replay.topics import agent_topics

from .bags import BYTES, DETECTION3DARRAY, POINTCLOUD2, detections, header, write_bag

DETECTED, TRACKED = (f"autoware_perception_msgs/msg/{name}" for name in ("DetectedObjects", "TrackedObjects"))
TEXT = "std_msgs/msg/String"


def chosen(
    tmp_path: Path, topics: dict[str, str], ego: str | None = None, others: tuple[str, ...] = ()
) -> dict[str, str]:
    """The topics of the agents in a bag with a message on each of these topics."""
    messages = {TEXT: {}, BYTES: {}, DETECTION3DARRAY: detections(1.0)}
    entries = [(name, kind, 1.0, messages.get(kind, {"header": header(1.0)})) for name, kind in topics.items()]
    with open_recording(write_bag(tmp_path / "bag", entries)) as recording:
        return {agent: topic.name for agent, topic in agent_topics(recording, ego, others).items()}


@pytest.mark.parametrize(
    ("topics", "agents"),
    [
        (
            {"/car1/objects": DETECTION3DARRAY, "/car2/objects": DETECTION3DARRAY},
            {"car1": "/car1/objects", "car2": "/car2/objects"},
        ),
        (
            {"/objects/red": TRACKED, "/objects/blue": TRACKED, "/objects/green": TRACKED},
            {"blue": "/objects/blue", "green": "/objects/green", "red": "/objects/red"},
        ),
        (
            {f"/{car}/all/{kind.rsplit('/')[-1]}": kind for car in "ab" for kind in (TRACKED, DETECTED)},
            {"a": "/a/all/DetectedObjects", "b": "/b/all/DetectedObjects"},
        ),
        (
            {f"/{car}/{name}": kind for car in "ab" for name, kind in (("points", POINTCLOUD2), ("objects", TRACKED))},
            {"a": "/a/objects", "b": "/b/objects"},
        ),
        (
            {"/a/points": POINTCLOUD2, "/b/points": POINTCLOUD2, "/note": TEXT, "/received": BYTES},
            {"a": "/a/points", "b": "/b/points"},
        ),
        (
            {"/ego_objects": TRACKED, "/rsu/detections": DETECTION3DARRAY},
            {"ego_objects": "/ego_objects", "rsu/detections": "/rsu/detections"},
        ),
    ],
    ids=[
        "two cars",
        "three, named at the end",
        "two sets of lists: that which comes first in the list of types",
        "lists before clouds",
        "clouds if there are no lists",
        "two topics of different types",
    ],
)  # fmt: skip
def test_topics_are_guessed(tmp_path: Path, topics: dict[str, str], agents: dict[str, str]) -> None:
    found = chosen(tmp_path, topics)
    assert found == agents
    assert list(found) == list(agents), "the first one is the ego"


def test_named_topics_are_taken(tmp_path: Path) -> None:
    topics = {"/x/objects": TRACKED, "/y/objects": DETECTION3DARRAY, "/y/other": TRACKED, "/air": BYTES}
    found = chosen(tmp_path, topics, "/y/objects", ("x/objects", "/air"))
    assert list(found.values()) == ["/y/objects", "/x/objects", "/air"]


def test_others_are_guessed_for_the_ego(tmp_path: Path) -> None:
    topics = {f"/{car}/objects": DETECTION3DARRAY for car in ("a", "b", "c")}
    assert list(chosen(tmp_path, topics, "/b/objects").values()) == ["/b/objects", "/a/objects", "/c/objects"]


@pytest.mark.parametrize(
    ("ego", "others", "message"),
    [
        ("/c/objects", (), r"bag: there is no topic '/c/objects'; there are /a/objects \(vision_msgs.*/b/objects"),
        ("/a/objects", ("/c",), r"there is no topic '/c'; there are /a/objects"),
        ("/a/objects", ("/note",), r"/note has std_msgs/msg/String, which has no objects; there are /a/objects"),
        ("/a/objects", ("/a/objects",), r"/a/objects: given twice"),
        ("/a/objects", ("/b/objects", "b/objects"), r"/b/objects: given twice"),
        ("/air", ("/b/objects",), r"/air: the ego needs object lists or point clouds"),
        (None, ("/a/objects",), r"give the topic of the ego, too"),
    ],
    ids=["unknown ego", "unknown other", "no objects", "ego twice", "other twice", "ego as messages", "no ego"],
)
def test_bad_topics_are_named(tmp_path: Path, ego: str | None, others: tuple[str, ...], message: str) -> None:
    topics = {"/a/objects": DETECTION3DARRAY, "/b/objects": DETECTION3DARRAY, "/note": TEXT, "/air": BYTES}
    with pytest.raises(ValueError, match=message):
        chosen(tmp_path, topics, ego, others)


@pytest.mark.parametrize(
    ("topics", "message"),
    [
        ({"/note": TEXT}, r"none has objects or point clouds, only /note \(std_msgs/msg/String\)"),
        ({"/a/objects": TRACKED}, r"name the agents' topics .*: there are /a/objects"),
        ({"/a/x": TRACKED, "/b/y": DETECTED, "/c/z/k": DETECTED}, r"name the agents' topics"),
    ],
    ids=["no objects", "one topic", "nothing in common"],
)
def test_ambiguous_topics_are_listed(tmp_path: Path, topics: dict[str, str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        chosen(tmp_path, topics)
