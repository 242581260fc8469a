"""The files of a replay, read back: the MCAP file by another library, lines of JSON, the page; and a full disk."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest

pytest.importorskip("rosbags", reason="recordings need rosbags")
pytest.importorskip("foxglove", reason="MCAP files for Foxglove need foxglove-sdk")

from cobevglue import Alignment, Boxes
from cobevglue.messages import from_dict
from cobevglue.object_collaboration import FusedObjects
from cobevglue.recordings import open_recording
from cobevglue.replay import Replay, ReplayFrame
from cobevglue.replay.run import run_replay
from cobevglue.replay.summary import Summary
from cobevglue.simulation.recording import write_recording

FRAMES = 12


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive") / "drive"
    write_recording(folder, seed=1, frames=FRAMES, agents=3)
    return folder


@pytest.fixture(scope="module")
def results(drive: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Summary, list[ReplayFrame]]:
    """Folder with the files, what was found, and the frames once more."""
    out = tmp_path_factory.mktemp("out") / "new"
    with open_recording(drive) as recording:
        summary, files = run_replay(Replay(recording), out)
    with open_recording(drive) as recording:
        frames = list(Replay(recording))
    assert [file.name for file in files] == ["index.html", "timeline.png", "frame.png", "replay.mcap", "frames.jsonl"]
    assert all(file.parent == out and file.stat().st_size > 1000 for file in files)
    return out, summary, frames


def mcap_messages(path: Path) -> dict[str, list[tuple[int, Any]]]:
    """Time [ns] and decoded message by topic, read by the library of the MCAP project and protobuf's own decoder."""
    reader = pytest.importorskip("mcap.reader", reason="the file is read back with mcap")
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    found: dict[str, list[tuple[int, Any]]] = {}
    with path.open("rb") as file:
        for schema, channel, message in reader.make_reader(file).iter_messages():
            if channel.message_encoding == "json":
                content = json.loads(message.data)
            else:
                pool = descriptor_pool.DescriptorPool()
                for part in descriptor_pb2.FileDescriptorSet.FromString(schema.data).file:
                    pool.Add(part)
                kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(schema.name))
                content = kind.FromString(message.data)
            found.setdefault(channel.topic, []).append((message.log_time, content))
    return found


def test_mcap_file_has_every_frame(results: tuple[Path, Summary, list[ReplayFrame]]) -> None:
    out, _, frames = results
    topics = mcap_messages(out / "replay.mcap")
    assert len(topics["/cobevglue/fused"]) == len(topics["/cobevglue/car1/objects"]) == FRAMES
    for frame, (time, scene) in zip(frames, topics["/cobevglue/fused"], strict=True):
        assert time == round(1e9 * frame.time)
        (entity,) = scene.entities
        assert entity.frame_id == "car1"
        cubes = np.array([(c.pose.position.x, c.pose.position.y, c.size.x, c.size.y) for c in entity.cubes])
        np.testing.assert_allclose(cubes, frame.seen.objects.bev[:, :4])
        yaw = [2.0 * math.atan2(c.pose.orientation.z, c.pose.orientation.w) for c in entity.cubes]
        np.testing.assert_allclose(np.cos(yaw - frame.seen.objects.yaw), 1.0, atol=1e-9)


def test_mcap_file_has_poses_and_verdicts(results: tuple[Path, Summary, list[ReplayFrame]]) -> None:
    out, _, frames = results
    topics = mcap_messages(out / "replay.mcap")
    for name in ("car2", "car3"):
        alignments = [frame.seen.alignments[name] for frame in frames if name in frame.seen.alignments]
        poses = [alignment.ego_SE2_other for alignment in alignments if alignment.ego_SE2_other is not None]
        sent = [t for _, t in topics["/cobevglue/tf"] if t.child_frame_id == name]
        assert [(t.parent_frame_id, t.translation.x, t.translation.y) for t in sent] == [
            ("car1", pose.x, pose.y) for pose in poses
        ]
        verdicts = [content for _, content in topics[f"/cobevglue/{name}/verdict"]]
        assert [verdict["accepted"] for verdict in verdicts] == [float(each.accepted) for each in alignments]
        assert [verdict["reason"] for verdict in verdicts] == [each.reason for each in alignments]
        assert [verdict["risk"] for verdict in verdicts] == pytest.approx([each.risk for each in alignments])
        boxes = [len(scene.entities[0].cubes) for _, scene in topics[f"/cobevglue/{name}/objects"]]
        assert [count > 0 for count in boxes] == [each.accepted for each in alignments], "gone while refused"


def test_lines_have_the_alignments_and_objects(results: tuple[Path, Summary, list[ReplayFrame]]) -> None:
    out, _, frames = results
    lines = [json.loads(line) for line in (out / "frames.jsonl").read_text(encoding="utf-8").splitlines()]
    assert [line["frame"] for line in lines] == list(range(FRAMES))
    for line, frame in zip(lines, frames, strict=True):
        assert line["time"] == frame.time
        assert set(line["stamps"]) == set(frame.stamps)
        np.testing.assert_allclose(from_dict({"boxes": line["objects"]}).center, frame.seen.objects.center)
        for name, alignment in frame.seen.alignments.items():
            assert line["alignments"][name]["accepted"] == alignment.accepted


def test_page_lists_agents_and_refusal_reasons(results: tuple[Path, Summary, list[ReplayFrame]]) -> None:
    out, summary, _ = results
    page = (out / "index.html").read_text(encoding="utf-8")
    for words in ("Replay of drive", "car2", "car3", "/car1/objects", "10.0 Hz"):
        assert words in page
    assert page.count("<img") >= 2
    for cause in summary.agents["car2"].refused:
        assert cause in page


def test_summary_counts_every_frame(results: tuple[Path, Summary, list[ReplayFrame]]) -> None:
    _, summary, frames = results
    assert (summary.frames, summary.alone) == (FRAMES, sum(not frame.seen.alignments for frame in frames))
    for name, series in summary.agents.items():
        found = [frame.seen.alignments[name] for frame in frames if name in frame.seen.alignments]
        assert len(series.rows) == len(found)
        assert series.accepted == sum(each.accepted for each in found)
        assert series.accepted + sum(series.refused.values()) == len(found)
    assert summary.fused_objects == sum(len(frame.seen.objects) for frame in frames)


def test_causes_of_refusals_are_put_together() -> None:
    summary = Summary()
    for reason in ("too few objects: evidence 3.1 nats", "too few objects: evidence 4.7 nats", "ambiguous"):
        seen = FusedObjects(Boxes.empty(), {"b": Alignment.refused(reason)}, {"a": Boxes.empty()})
        summary.add(ReplayFrame(0, 0.0, 0.0, {}, {}, seen), "a")
    assert dict(summary.agents["b"].refused) == {"too few objects": 2, "ambiguous": 1}


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs /dev/full, a file on a full disk")
@pytest.mark.parametrize("name", ["replay.mcap", "frames.jsonl"])
def test_full_disk_is_reported(drive: Path, tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str) -> None:
    (tmp_path / name).symlink_to("/dev/full")
    with open_recording(drive) as recording, pytest.raises(OSError, match="No space left") as caught:
        run_replay(Replay(recording), tmp_path)
    assert caught.value.filename == str(tmp_path)
    assert capfd.readouterr().err == "", "the library that writes has said nothing itself"


def test_recording_for_rerun(drive: Path, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="recordings for its viewer need rerun-sdk")
    with open_recording(drive) as recording:
        _, files = run_replay(Replay(recording), tmp_path, rerun=True)
    assert files[-1] == tmp_path / "replay.rrd"
    assert files[-1].stat().st_size > 1000
