"""Results on disk are those in memory."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

from cobevglue.boxes import Boxes
from cobevglue.experiments.condition import Condition
from cobevglue.experiments.results import (
    ConditionResult,
    FrameResult,
    FrameTruth,
    ReceivedPose,
    ScenarioResult,
    read_result,
    write_result,
)

pytest.importorskip("torch")

CONDITION = Condition(
    fusion="cobevglue", aligner="bevglue", disturbance="noise", disturbance_options={"position": 0.5, "yaw": 0.5}
)
ACCEPTED = ReceivedPose("car2", 0.25, 0.01, 0.5, "", {"boxes": 240, "features": 2_816_067}, 240)
REFUSED = ReceivedPose("car3", math.inf, math.inf, math.inf, "too few common objects", {"boxes": 0, "features": 7}, 0)


def boxes(count: int, shift: float = 0.0) -> Boxes:
    """Detections whose numbers float32 has exactly."""
    x = np.arange(count) * 8.0 + shift
    return Boxes(np.column_stack([x, x / 2, -np.ones(count)]), [[4.5, 2.0, 1.5]] * count, x / 64, 1 / (1 + x / 8))


def result() -> ScenarioResult:
    truth = [
        FrameTruth(
            "000000", boxes(3).replace(score=None, label=["car", "van", "car"]), np.array([5, 0, 7]), {"a": 2}, {}
        ),
        FrameTruth("000002", boxes(0).replace(score=None), np.zeros(0, np.int64), {}, {"head": 0.25}),
    ]
    frames = {0: FrameResult(boxes(2), (ACCEPTED, REFUSED), {"fusion": 0.5}), 1: FrameResult(boxes(0), (), {})}
    other = CONDITION.model_copy(update={"fusion": "late", "every": 2})
    return ScenarioResult(
        "sequence one",
        "car1",
        truth,
        {"agents without a cloud": 3},
        {
            CONDITION.key: ConditionResult(CONDITION, "abc", frames),
            other.key: ConditionResult(other, "def", {0: FrameResult(boxes(4, 0.5), (ACCEPTED,), {})}),
        },
    )


def same(a: Boxes, b: Boxes) -> bool:
    pairs = ((a.center, b.center), (a.size, b.size), (a.yaw, b.yaw), (a.score, b.score), (a.label, b.label))
    return all((one is None and other is None) or np.array_equal(one, other) for one, other in pairs)  # type: ignore[arg-type]


def test_written_results_read_back(tmp_path: Path) -> None:
    before = result()
    write_result(tmp_path / "folder" / "one.npz", before)
    after = read_result(tmp_path / "folder" / "one.npz")
    assert (after.scenario, after.ego, after.left_out) == (before.scenario, before.ego, before.left_out)
    assert list(after.conditions) == list(before.conditions)
    for one, other in zip(before.truth, after.truth, strict=True):
        assert same(one.objects, other.objects)
        assert one.point_count.tolist() == other.point_count.tolist()
        assert (one.timestamp, one.co_visible, one.seconds) == (other.timestamp, other.co_visible, other.seconds)
    for key, run in before.conditions.items():
        read = after.conditions[key]
        assert (read.condition, read.fingerprint, list(read.frames)) == (
            run.condition,
            run.fingerprint,
            list(run.frames),
        )
        for index, frame in run.frames.items():
            assert same(frame.boxes.replace(score=np.float32(frame.boxes.score)), read.frames[index].boxes)
            assert (frame.received, frame.seconds) == (read.frames[index].received, read.frames[index].seconds)


def test_a_drive_without_a_frame_reads_back(tmp_path: Path) -> None:
    write_result(tmp_path / "none.npz", ScenarioResult("d", "", [], {}, {}))
    after = read_result(tmp_path / "none.npz")
    assert (after.ego, after.truth, after.conditions) == ("", [], {})


@pytest.mark.parametrize("damage", ["cut", "text", "other"])
def test_damaged_or_foreign_file_is_named(tmp_path: Path, damage: str) -> None:
    path = tmp_path / "one.npz"
    write_result(path, result())
    if damage == "cut":
        path.write_bytes(path.read_bytes()[:-200])
    elif damage == "text":
        path.write_text("no result")
    else:
        np.savez(path, boxes=np.zeros(3))
    with pytest.raises(ValueError, match=r"one\.npz: damaged, or not the result of a sequence"):
        read_result(path)


@pytest.mark.parametrize(("k", "within"), [(0.2, False), (0.5, False), (0.6, True), (3.0, True)])
def test_success_needs_both_metres_and_degrees(k: float, within: bool) -> None:
    assert ACCEPTED.success(k) is within  # 0.25 m, 0.57 degrees
    assert not REFUSED.success(k)
    assert (ACCEPTED.accepted, REFUSED.accepted) == (True, False)
