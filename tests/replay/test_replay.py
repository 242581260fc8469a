"""Replay of bags made by hand and of a simulated drive: pairing, time stamps of all kinds, messages and clouds."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cobevglue import Boxes
from cobevglue.evaluation.alignment_data import v2v4real_sequences
from cobevglue.messages import ObjectMessage, encode
from cobevglue.simulation import Junction, JunctionSettings

pytest.importorskip("rosbags", reason="recordings need rosbags")

from cobevglue.recordings import new_detection_bag, open_recording
from cobevglue.replay import Replay, ReplayFrame
from cobevglue.simulation.recording import STAGGER, write_recording

from .bags import BYTES, DETECTION3DARRAY, POINTCLOUD2, UDP, Entry, detection, detections, header, pose, write_bag

A, B = "/a/objects", "/b/objects"


def lists(topic: str, *times: float | tuple[float, float], identity: str = "") -> list[Entry]:
    """Lists of a car each, received 0.01 s after their time stamp, or (time of receipt, time stamp)."""
    pairs = [time if isinstance(time, tuple) else (time + 0.01, time) for time in times]
    return [
        (topic, DETECTION3DARRAY, received, detections(stamp, detection(10.0, 0.0, identity), detection(20.0, 5.0)))
        for received, stamp in pairs
    ]


@contextmanager
def replay(tmp_path: Path, *entries: list[Entry], **options: Any) -> Iterator[Replay]:
    every = sorted((entry for part in entries for entry in part), key=lambda entry: entry[2])
    with open_recording(write_bag(tmp_path / "bag", every)) as recording:
        yield Replay(recording, **{"ego": A, "others": [B], **options})


def run(made: Replay) -> list[ReplayFrame]:
    return list(made)


def test_newest_list_before_the_ego_is_taken(tmp_path: Path) -> None:
    with replay(tmp_path, lists(A, 1.0, 1.1, 1.2), lists(B, 0.93, 1.13, 1.18)) as made:
        frames = run(made)
    assert [frame.time for frame in frames] == [1.0, 1.1, 1.2]
    assert [frame.stamps["b"] for frame in frames] == pytest.approx([0.93, 0.93, 1.18])
    assert [frame.ages["b"] for frame in frames] == pytest.approx([0.07, 0.17, 0.02])


def test_order_is_that_of_receipt(tmp_path: Path) -> None:
    """A list that shows an earlier instant but is received later is not there yet."""
    with replay(tmp_path, lists(A, 1.0, 1.1), lists(B, (1.05, 0.9))) as made:
        assert [list(frame.ages) for frame in run(made)] == [[], ["b"]]


def test_old_lists_are_not_used(tmp_path: Path) -> None:
    with replay(tmp_path, lists(A, 1.0, 1.2, 1.4), lists(B, 0.95), max_age=0.3) as made:
        assert [list(frame.seen.alignments) for frame in run(made)] == [["b"], ["b"], []]


def test_late_and_doubled_lists_are_counted(tmp_path: Path) -> None:
    times = [(1.01, 1.0), (1.02, 1.0), (1.06, 1.05), (1.07, 1.02), (1.2, 1.15)]
    with replay(tmp_path, lists(A, 1.1, 1.3), lists(B, *times)) as made:
        frames = run(made)
    stream = made.streams["b"]
    assert (stream.lists, stream.doubled, stream.late, stream.set_back) == (5, 1, 1, 0)
    assert [frame.stamps["b"] for frame in frames] == pytest.approx([1.05, 1.15])
    assert stream.longest_gap == pytest.approx(0.1)
    assert [problem.partition(": ")[2] for problem in stream.problems()] == [
        "1 lists have the time stamp of the one before and are not used",
        "1 lists came after a newer one and are not used",
    ]


@pytest.mark.parametrize("topic", [A, B], ids=["of the ego", "of the other"])
def test_clock_that_is_set_back(tmp_path: Path, topic: str) -> None:
    other = B if topic == A else A
    jumping = [(1.0 + 0.1 * k, (500.0 if k < 3 else 20.0) + 0.1 * k) for k in range(6)]
    with replay(tmp_path, lists(topic, *jumping), lists(other, *(0.99 + 0.1 * k for k in range(7)))) as made:
        frames = run(made)
    assert made.streams[topic[1]].set_back == 1
    assert made.streams[topic[1]].late == 0
    assert len(frames) == (6 if topic == A else 7)


def test_lists_without_time_stamps(tmp_path: Path) -> None:
    times = [(1.0, 0.0), (1.1, 0.0)]
    with replay(tmp_path, lists(A, *times), lists(B, *times)) as made:
        frames = run(made)
    assert [frame.time for frame in frames] == pytest.approx([1.0, 1.1])
    assert made.streams["a"].unstamped == 2


def test_identities_that_end_are_replaced(tmp_path: Path) -> None:
    first = [
        (A, DETECTION3DARRAY, 1.0 + 0.1 * k, detections(1.0 + 0.1 * k, detection(10, 0, "car-7"))) for k in range(3)
    ]
    with replay(tmp_path, first, lists(A, 1.4, 1.5), lists(B, 1.0)) as made:
        frames = run(made)
    assert made.streams["a"].new_identities == 1
    ids = [frame.seen.lists["a"].track_id for frame in frames]
    assert all(each is not None for each in ids)


def test_objects_without_size_are_counted(tmp_path: Path) -> None:
    point = {"bbox": {"center": {"orientation": {"w": 1.0}}}}
    entry = (A, DETECTION3DARRAY, 1.0, detections(1.0, detection(10, 0), point))
    with replay(tmp_path, [entry], lists(B, 0.9)) as made:
        assert [len(frame.seen.lists["a"]) for frame in run(made)] == [1]
    assert made.streams["a"].without_size == 1


@pytest.mark.parametrize(
    ("message", "words"),
    [
        (detections(1.2, {"bbox": {"size": {"x": 1.0, "y": 1.0}}}), "detections: row 0: orientation must be a unit"),
        (detections(1.2, detection(np.nan, 0)), "detections: center: row 0 is not finite"),
        (detections(1.2, detection(1, 0), detection(5.3e6, 0)), "center: row 1 has 5.3e.06 m, .* own frame"),
        (detections(1.2, {"bbox": {"center": pose(1, 0), "size": {"x": 9e9, "y": 1.0}}}), "size: row 0 has 9e.09 m"),
        (
            detections(1.2, detection(1, 0), frame_id="car/map"),
            "frame_id: this is in the frame 'car/map', and there are no",
        ),
    ],
    ids=["no orientation", "NaN", "coordinates of a map", "size", "a map"],
)
def test_bad_message_is_named(tmp_path: Path, message: dict[str, Any], words: str) -> None:
    bad = (B, DETECTION3DARRAY, 1.2, message)
    with (
        replay(tmp_path, lists(A, 1.0, 1.1, 1.3), lists(B, 0.9, 1.05), [bad]) as made,
        pytest.raises(ValueError, match=rf"bag: /b/objects: message 3 \(received at 1.200 s\): {words}"),
    ):
        run(made)


def own_message(agent: str, time: float) -> bytes:
    boxes = Boxes([(5, 5, 0)], [(4.5, 1.9, 1.5)], [0.0])
    return encode(ObjectMessage(agent, time, 0, boxes, Boxes([(0, 0, 0)], [(4.5, 1.9, 1.5)], [0.0])))


def test_messages_of_several_senders(tmp_path: Path) -> None:
    """Senders have clocks of their own, and their own vehicles are objects."""
    heard = [
        ("/air", BYTES, 0.95 + 0.1 * k, {"data": np.frombuffer(own_message(agent, 77.0 + 0.1 * k), np.uint8)})
        for k in range(3)
        for agent in ("x", "y")
    ]
    with replay(tmp_path, lists(A, 1.0, 1.1, 1.2), heard, others=["/air"]) as made:
        frames = run(made)
    assert set(made.streams) == {"a/objects", "x", "y"}
    assert set(frames[-1].seen.alignments) == {"x", "y"}
    assert frames[-1].stamps["x"] == pytest.approx(77.2)


def test_cpm_in_packets(tmp_path: Path) -> None:
    pytest.importorskip("asn1tools", reason="CPMs need asn1tools")
    from cobevglue.messages.cpm import CollectivePerception
    from cobevglue.messages.cpm import encode as encode_cpm

    boxes = Boxes([(5, 5, 0)], [(4.5, 1.9, 1.5)], [0.0], track_id=[3])
    data = encode_cpm(CollectivePerception(station_id=42, time=100.0, boxes=boxes, heading=0.5))
    packets = [
        (
            "/cpm",
            UDP,
            0.9,
            {"header": header(0.9), "data": np.frombuffer(struct.pack(">HH", 2009, 0) + data, np.uint8)},
        ),
    ]
    with replay(tmp_path, lists(A, 1.0), packets, others=["/cpm"]) as made:
        (frame,) = run(made)
    np.testing.assert_allclose(frame.seen.lists["42"].center[:, :2], [[5, 5]], atol=0.02)


def test_sdsm_bytes_are_read(tmp_path: Path) -> None:
    pytest.importorskip("asn1tools", reason="SDSMs need asn1tools")
    from cobevglue.messages import sdsm

    boxes = Boxes([(5, 5, 0)], [(4.5, 1.9, 1.5)], [0.0], track_id=[3])
    data = sdsm.encode(sdsm.SensorDataSharing(station_id=42, time=100.0, boxes=boxes))
    sent = ("/sdsm", BYTES, 0.9, {"data": np.frombuffer(data, np.uint8)})
    with replay(tmp_path, lists(A, 1.0), [sent], others=["/sdsm"]) as made:
        (frame,) = run(made)
    np.testing.assert_allclose(frame.seen.lists["42"].center[:, :2], [[5, 5]], atol=0.051)


def test_damaged_message_is_named(tmp_path: Path) -> None:
    pytest.importorskip("asn1tools", reason="CPMs need asn1tools")
    broken = ("/air", BYTES, 0.9, {"data": np.arange(20)})
    with (
        replay(tmp_path, lists(A, 1.0), [broken], others=["/air"]) as made,
        pytest.raises(ValueError, match=r"/air: message 1 .*neither a CPM, an SDSM nor a message of cobevglue"),
    ):
        run(made)


def test_two_agents_with_one_id(tmp_path: Path) -> None:
    data = {"data": np.frombuffer(own_message("x", 77.0), np.uint8)}
    heard = [("/air1", BYTES, 0.9, data), ("/air2", BYTES, 0.95, data)]
    with (
        replay(tmp_path, lists(A, 1.0), heard, others=["/air1", "/air2"]) as made,
        pytest.raises(ValueError, match=r"/air2: message 1 .*agent 'x' is on /air1, too"),
    ):
        run(made)


def test_simulated_drive_is_aligned(tmp_path: Path) -> None:
    """Poses and time offsets of a drive that was recorded at different instants, against the truth."""
    write_recording(tmp_path / "drive", seed=1, frames=40, agents=3)
    with open_recording(tmp_path / "drive") as recording:
        made = Replay(recording)
        frames = run(made)
    assert list(made.topics) == ["car1", "car2", "car3"]
    assert len(frames) == 40
    traffic = Junction(1, JunctionSettings(agents=3, duration=4.0)).traffic
    for number, name in ((1, "car2"), (2, "car3")):
        errors, offsets = [], []
        for frame in frames[10:]:
            found = frame.seen.alignments[name]
            objects = traffic.at(0.1 * frame.index)
            truth = objects[[0, number]]
            if found.ego_SE2_other is not None:
                seen = objects.center[0, :2] + turned(found.ego_SE2_other.apply(np.zeros((1, 2)))[0], objects.yaw[0])
                errors.append(np.hypot(*(seen - truth.center[1, :2])))
                offsets.append(found.time_offset)
        assert len(errors) >= 25
        assert np.median(errors) < 0.5
        assert np.median(offsets) == pytest.approx(STAGGER * number - 0.1, abs=0.03)


def test_two_real_cars(tmp_path: Path, real_data: Path) -> None:
    """Detections of two real cars, V2V4Real, in a bag: the lists of the other car show the world a little later."""
    (sequence,) = v2v4real_sequences(real_data / "v2v4real_detections", ("val/0004",))
    pairs = list(sequence.frames)
    with new_detection_bag(tmp_path / "drive") as bag:
        for index, pair in enumerate(pairs):
            time = 50.0 + 0.1 * index
            for name, boxes in (("other", pair.other), ("ego", pair.ego)):
                bag.write(f"/{name}/objects", time, time, "lidar", boxes.replace(track_id=None))
    with open_recording(tmp_path / "drive") as recording:
        frames = run(Replay(recording, "/ego/objects", ["/other/objects"]))
    found = [frame.seen.alignments["other"] for frame in frames]
    near = [  # where the boxes of the other car come to lie
        np.abs(each.ego_SE2_other.apply(pair.other.center) - pair.ego_SE2_other.apply(pair.other.center)).mean() < 1.5
        for each, pair in zip(found, pairs, strict=True)
        if each.ego_SE2_other is not None
    ]
    assert len(near) > 0.9 * len(pairs)
    assert np.mean(near) > 0.95
    assert 0.0 < np.median([each.time_offset for each in found]) < 0.2


def turned(point: np.ndarray, yaw: float) -> np.ndarray:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([c * point[0] - s * point[1], s * point[0] + c * point[1]])


def test_clouds_go_through_the_detector(tmp_path: Path) -> None:
    pytest.importorskip("torch", reason="the detector needs torch")
    rng = np.random.default_rng(0)
    points = rng.uniform([-30, -20, -2, 0], [30, 20, -1.8, 1], (2000, 4)).astype(np.float32)
    fields = [{"name": name, "offset": 4 * k, "datatype": 7, "count": 1} for k, name in enumerate("xyzi")]
    message = {
        "fields": fields, "height": 1, "width": len(points), "point_step": 16, "row_step": 16 * len(points),
        "data": np.frombuffer(points.tobytes(), np.uint8),
    }  # fmt: skip
    times = (1.0, 1.1, 0.0)  # the last one without a time stamp
    clouds = [
        (f"/{agent}/points", POINTCLOUD2, 1.0 + 0.1 * k, {"header": header(stamp), **message})
        for k, stamp in enumerate(times)
        for agent in "ba"
    ]
    with replay(tmp_path, clouds, ego=None, others=[]) as made:
        frames = run(made)
    assert len(frames) == 3
    assert all(set(frame.seen.lists) == {"a", "b"} for frame in frames)


@pytest.mark.parametrize("max_age", [0.0, -1.0, np.nan])
def test_bad_age_is_refused(tmp_path: Path, max_age: float) -> None:
    with (
        pytest.raises(ValueError, match="max_age must be > 0"),
        replay(tmp_path, lists(A, 1.0), lists(B, 1.0), max_age=max_age),
    ):
        pass
