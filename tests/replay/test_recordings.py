"""Recordings: every kind of file that rosbags writes is read, and what is no recording is named in one line."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cobevglue import Boxes
from cobevglue.interop.ros import boxes_from_ros, stamp_from_ros

pytest.importorskip("rosbags", reason="recordings need rosbags")

from cobevglue.recordings import new_detection_bag, open_recording
from cobevglue.recordings.message_definitions import LAYOUTS

from .bags import (
    DETECTION3DARRAY,
    Entry,
    detection,
    detections,
    header,
    pose,
    store_of,
    write_bag,
    write_ros1_bag,
)

BOXES = Boxes(
    [(10, 2, -1), (20, -5, -0.5)], [(4.5, 1.9, 1.5), (8, 2.5, 3)], [0.3, -3.0], [0.9, 0.4], [7, 8], ["car", "bus"]
)
TWO_TOPICS: list[Entry] = [
    ("/a/objects", DETECTION3DARRAY, 5.0, detections(4.9, detection(10, 0, "x"))),
    ("/b/objects", DETECTION3DARRAY, 5.1, detections(5.0, detection(20, 0, "y"), detection(30, 0, "z"))),
    ("/a/objects", DETECTION3DARRAY, 5.2, detections(5.1)),
]
FOXY_DETECTION = {
    "results": [{"id": "car", "score": 0.9}],
    "bbox": {"center": pose(10, 0), "size": {"x": 4.5, "y": 1.9, "z": 1.5}},
    "is_tracking": True,
    "tracking_id": "x",
}
AUTOWARE_OBJECT = {
    "object_id": {"uuid": np.arange(16)},
    "existence_probability": 0.75,
    "classification": [{"label": 1, "probability": 0.6}, {"label": 2, "probability": 0.4}],
    "kinematics": {"pose_with_covariance": {"pose": pose(10, 5, 1.0)}},
    "shape": {"type": 0, "dimensions": {"x": 4.5, "y": 1.9, "z": 1.5}},
}


def read(path: Path, *topics: str) -> list[tuple[str, float, Any]]:
    with open_recording(path) as recording:
        return list(recording.messages(topics or recording.topics))


def test_written_boxes_are_read_as_they_were(tmp_path: Path) -> None:
    with new_detection_bag(tmp_path / "drive") as bag:
        bag.write("/a/objects", 12.25, 12.125, "lidar", BOXES)
        bag.write("/a/objects", 12.35, 12.225, "lidar", Boxes.empty())
    (topic, received, message), (_, _, empty) = read(tmp_path / "drive")
    assert (topic, received, stamp_from_ros(message)) == ("/a/objects", 12.25, 12.125)
    assert message.header.frame_id == "lidar"
    found = boxes_from_ros(message, {}).boxes
    np.testing.assert_allclose(found.center, BOXES.center)
    np.testing.assert_allclose(found.size, BOXES.size)
    np.testing.assert_allclose(found.yaw, BOXES.yaw)
    assert found.score is not None
    np.testing.assert_allclose(found.score, [0.9, 0.4])
    assert found.label is not None
    assert found.label.tolist() == ["car", "bus"]
    assert found.track_id is not None
    assert found.track_id.tolist() == [0, 1], "identities are numbered as they come"
    assert len(boxes_from_ros(empty).boxes) == 0


@pytest.mark.parametrize(
    "kind", ["folder with MCAP", "MCAP file", "folder with SQLite", "SQLite file", "without types"]
)
def test_every_kind_of_bag_is_read(tmp_path: Path, kind: str) -> None:
    sqlite = "MCAP" not in kind
    path = write_bag(tmp_path / "bag", TWO_TOPICS, sqlite=sqlite, with_definitions=kind != "without types")
    if "file" in kind:
        (path,) = [*path.glob("*.mcap"), *path.glob("*.db3")]
    with open_recording(path) as recording:
        assert {name: (topic.type, topic.count) for name, topic in recording.topics.items()} == {
            "/a/objects": (DETECTION3DARRAY, 2),
            "/b/objects": (DETECTION3DARRAY, 1),
        }
    assert [(topic, round(received, 6), len(message.detections)) for topic, received, message in read(path)] == [
        ("/a/objects", 5.0, 1),
        ("/b/objects", 5.1, 2),
        ("/a/objects", 5.2, 0),
    ]
    assert [topic for topic, _, _ in read(path, "/b/objects")] == ["/b/objects"]


@pytest.mark.parametrize("compressed", ["file", "message", "storage"])
def test_compressed_bags_are_read(tmp_path: Path, compressed: str) -> None:
    path = write_bag(tmp_path / "bag", TWO_TOPICS, sqlite=compressed != "storage", compressed=compressed)
    assert [len(message.detections) for _, _, message in read(path)] == [1, 2, 0]


def test_another_writer_and_reader_agree(tmp_path: Path) -> None:
    """What mcap-ros2-support writes is read here, and it reads what is written here."""
    pytest.importorskip("mcap_ros2", reason="the other reader and writer is mcap-ros2-support")
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory
    from mcap_ros2.writer import Writer

    with new_detection_bag(tmp_path / "ours") as bag:
        bag.write("/a/objects", 12.25, 12.125, "lidar", BOXES)
    with (tmp_path / "ours" / "ours.mcap").open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        ((schema, channel, _, message),) = reader.iter_decoded_messages()
    assert schema is not None
    assert (schema.name, channel.topic) == (DETECTION3DARRAY, "/a/objects")
    read_by_other = boxes_from_ros(message, {}).boxes
    with (tmp_path / "theirs.mcap").open("wb") as stream:
        writer = Writer(stream)
        kind = writer.register_msgdef(DETECTION3DARRAY, schema.data.decode())
        writer.write_message("/b/objects", kind, detections(4.9, detection(10, 0, "x")), log_time=5 * 10**9)
        writer.finish()  # type: ignore[no-untyped-call]
    ((topic, received, message),) = read(tmp_path / "theirs.mcap")
    assert (topic, received, stamp_from_ros(message)) == ("/b/objects", 5.0, 4.9)
    np.testing.assert_allclose(boxes_from_ros(message).boxes.center, [[10, 0, 0]])
    np.testing.assert_allclose(read_by_other.bev, BOXES.bev)


@pytest.mark.parametrize("with_definitions", [True, False])
def test_layout_before_humble_is_read(tmp_path: Path, with_definitions: bool) -> None:
    foxy = LAYOUTS[1]
    entry = ("/a", DETECTION3DARRAY, 1.0, {"header": header(0.9), "detections": [FOXY_DETECTION]})
    path = write_bag(tmp_path / "bag", [entry], sqlite=True, definitions=foxy, with_definitions=with_definitions)
    ((_, _, message),) = read(path)
    boxes = boxes_from_ros(message, {}).boxes
    assert boxes.label is not None
    assert boxes.label.tolist() == ["car"]
    assert boxes.track_id is not None


@pytest.mark.parametrize("with_definitions", [True, False])
@pytest.mark.parametrize("package", ["autoware_perception_msgs", "autoware_auto_perception_msgs"])
@pytest.mark.parametrize("name", ["DetectedObjects", "TrackedObjects"])
def test_objects_of_autoware_are_read(tmp_path: Path, name: str, package: str, with_definitions: bool) -> None:
    one = {key: value for key, value in AUTOWARE_OBJECT.items() if name == "TrackedObjects" or key != "object_id"}
    entry = ("/a", f"{package}/msg/{name}", 1.0, {"header": header(0.9), "objects": [one]})
    path = write_bag(tmp_path / "bag", [entry], sqlite=True, with_definitions=with_definitions)
    ((_, _, message),) = read(path)
    boxes = boxes_from_ros(message, {}).boxes
    np.testing.assert_allclose(boxes.bev, [[10, 5, 4.5, 1.9, 1.0]])
    assert boxes.label is not None
    assert boxes.label.tolist() == ["car"]
    assert boxes.score is not None
    assert boxes.score.tolist() == [0.75]
    assert (boxes.track_id is None) == (name == "DetectedObjects")


def test_bag_of_ros1_is_read(tmp_path: Path) -> None:
    definitions = {name: text for name, text in LAYOUTS[1].items() if name.startswith("vision_msgs")}
    entry = ("/a", DETECTION3DARRAY, 1.0, {"header": header(0.9), "detections": [FOXY_DETECTION]})
    path = write_ros1_bag(tmp_path / "old.bag", [entry], definitions)
    ((topic, received, message),) = read(path)
    assert (topic, received, stamp_from_ros(message)) == ("/a", 1.0, 0.9)
    assert len(boxes_from_ros(message).boxes) == 1


def test_unknown_type_without_definition_is_named(tmp_path: Path) -> None:
    definitions = {"my_msgs/msg/Things": "int32 number"}
    path = write_bag(
        tmp_path / "bag",
        [("/things", "my_msgs/msg/Things", 1.0, {"number": 3})],
        sqlite=True,
        definitions=definitions,
        with_definitions=False,
    )
    with pytest.raises(ValueError, match=r"bag: /things: message 1: .* no definition of my_msgs/msg/Things"):
        read(path)


def test_message_of_another_layout_is_named(tmp_path: Path) -> None:
    definitions = {DETECTION3DARRAY: "int32 number"}
    path = write_bag(
        tmp_path / "bag",
        [("/a", DETECTION3DARRAY, 1.0, {"number": 3})],
        sqlite=True,
        definitions=definitions,
        with_definitions=False,
    )
    with pytest.raises(ValueError, match=r"no definition of vision_msgs.*does not fit"):
        read(path)


def cut(data: bytes) -> bytes:
    return data[: len(data) // 2]


def spoilt(data: bytes) -> bytes:
    start = data.index(b"zstd") + 16  # in the compressed messages
    return data[:start] + bytes(value ^ 255 for value in data[start : start + 50]) + data[start + 50 :]


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("cut.mcap", cut, "cut.mcap: the file is truncated"),
        ("spoilt.mcap", spoilt, "spoilt.mcap: "),
        ("empty.mcap", lambda _: b"", "empty.mcap.* empty"),
        ("text.mcap", lambda _: b"hello " * 30, "text.mcap: this is no MCAP file"),
        ("text.db3", lambda _: b"hello " * 300, "text.db3.*not a database"),
        ("text.bag", lambda _: b"hello " * 30, "text.bag: "),
        ("drive.txt", lambda _: b"hello", r"drive.txt: a recording ends with .mcap, .db3, .bag"),
    ],
)
def test_file_that_is_no_recording_is_named(tmp_path: Path, name: str, content: Any, message: str) -> None:
    with new_detection_bag(tmp_path / "good") as bag:
        for number in range(50):
            bag.write("/a/objects", 1.0 + number, 1.0 + number, "lidar", BOXES)
    path = tmp_path / name
    path.write_bytes(content((tmp_path / "good" / "good.mcap").read_bytes()))
    with pytest.raises(ValueError, match=message):
        read(path)


@pytest.mark.parametrize("sqlite", [False, True], ids=["MCAP", "SQLite"])
def test_spoilt_bags_are_errors_or_readable(tmp_path: Path, sqlite: bool) -> None:
    """Whatever bytes are changed: an error of one kind, or messages."""
    good = write_bag(tmp_path / "good", TWO_TOPICS, sqlite=sqlite)
    (path,) = [*good.glob("*.mcap"), *good.glob("*.db3")]
    data = path.read_bytes()
    readable = refused = 0
    for seed in range(60):
        rng = np.random.default_rng([seed, 0, 0])
        changed = bytearray(data)
        for place in rng.integers(0, len(data), 3):
            changed[place] = rng.integers(256)
        (tmp_path / path.name).write_bytes(changed[: int(rng.integers(len(data)))] if seed % 10 == 0 else changed)
        try:
            for _, _, message in read(tmp_path / path.name, "/a/objects", "/b/objects"):
                boxes_from_ros(message)
            readable += 1
        except ValueError:
            refused += 1
    assert min(readable, refused) > 0


def test_folders_that_are_no_bags(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match=r"empty: a folder without metadata.yaml .* no recording in it"):
        read(tmp_path / "empty")
    path = write_bag(tmp_path / "bag", TWO_TOPICS)
    (path / "metadata.yaml").unlink()
    with pytest.raises(ValueError, match=r"give one of its files, such as .*bag.mcap"):
        read(path)
    (path / "metadata.yaml").write_text("a: 1\n")
    with pytest.raises(ValueError, match=r"bag: .*metadata"):
        read(path)
    with pytest.raises(FileNotFoundError, match="nowhere"):
        read(tmp_path / "nowhere")


def test_bag_is_not_replaced(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "bag", TWO_TOPICS)
    with pytest.raises(FileExistsError, match="bag: exists already"), new_detection_bag(path):
        pass


def test_our_definitions_are_complete() -> None:
    for layout in LAYOUTS:
        assert set(layout) <= set(store_of(layout).types)
