"""The demonstration: what it measures, what it writes, and that BEVGlue gets boxes only."""

from __future__ import annotations

import json
import math
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cobevglue.alignment import Alignment, BEVGlue
from cobevglue.boxes import Boxes
from cobevglue.cli import main
from cobevglue.demo import BEVGLUE, POSE_SOURCES, TRUE_POSE, DemoResult, run_demo
from cobevglue.messages import encoded_size
from cobevglue.simulation import Junction

FILES = ("index.html", "object_graphs.png", "placements.png", "error_over_time.png", "animation.gif")


@pytest.fixture(scope="module")
def drive() -> DemoResult:
    return run_demo(0)


def without_times(result: DemoResult) -> dict[str, Any]:
    summary = result.summary()
    alignment = {key: value for key, value in summary["alignment"].items() if not key.endswith("ms")}
    return {**summary, "alignment": alignment}


def test_bevglue_finds_the_other_car_and_places_its_boxes_better_than_gps(drive: DemoResult) -> None:
    summary = drive.summary()
    assert summary["frames"] == 80
    assert summary["alignment"]["success_2m_2deg"] >= 0.9
    assert summary["alignment"]["wrong_accepts"] <= 0.02
    error = {source: summary["placement"][source]["mean_error_m"] for source in POSE_SOURCES}
    assert error[TRUE_POSE] < error[BEVGLUE] < error["gps_0.5"] < error["gps_2.5"] < error["gps_attacked"]


def test_the_numbers_are_what_their_names_say(drive: DemoResult) -> None:
    summary = drive.summary()
    errors = [frame.pose_error for frame in drive.frames]
    for level in (1, 2, 3):
        good = [e is not None and e[0] <= level and math.degrees(e[1]) <= level for e in errors]
        assert summary["alignment"][f"success_{level}m_{level}deg"] == pytest.approx(sum(good) / 80)
    assert summary["alignment"]["refused"] == pytest.approx(errors.count(None) / 80)
    sizes = [encoded_size(len(frame.other), "car2") for frame in drive.frames]
    assert summary["message_bytes_per_frame"] == pytest.approx(sum(sizes) / 80)
    assert summary["placement"]["gps_2.5"]["frames"] == 1.0
    assert summary["placement"][TRUE_POSE]["boxes_within_2m"] > 0.95
    json.dumps(summary, allow_nan=False)


def test_the_error_with_the_true_pose_is_the_detectors_own(drive: DemoResult) -> None:
    frame, simulated = drive.frames[40], Junction(0)[40].agents["car2"]
    real = simulated.object_id >= 0
    assert simulated.visible.track_id is not None
    rows = [simulated.visible.track_id.tolist().index(i) for i in simulated.object_id[real]]
    own = np.linalg.norm(simulated.boxes.center[real, :2] - simulated.visible.center[rows, :2], axis=1)
    error = frame.placement_error(TRUE_POSE)
    assert error is not None
    np.testing.assert_allclose(error, own, atol=1e-4)


def test_the_same_seed_gives_the_same_drive() -> None:
    first, again, different = (run_demo(seed, frames=8) for seed in (3, 3, 4))
    assert without_times(first) == without_times(again)
    assert without_times(first) != without_times(different)


def test_bevglue_gets_boxes_and_a_time_and_no_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[tuple[Any, ...]] = []
    align = BEVGlue.align

    def watched(self: BEVGlue, *arguments: Any, **named: Any) -> Alignment:
        seen.append((*arguments, *named.values()))
        return align(self, *arguments, **named)

    monkeypatch.setattr(BEVGlue, "align", watched)
    run_demo(0, frames=3)
    scene = Junction(0)
    for index, (ego, other, time) in enumerate(seen[-3:]):
        assert isinstance(time, float)
        for boxes, name in ((ego, "car1"), (other, "car2")):
            assert isinstance(boxes, Boxes)
            np.testing.assert_allclose(boxes.bev, scene[index].agents[name].boxes.bev, atol=1e-4)


@pytest.mark.parametrize("frames", [0, 81])
def test_the_number_of_frames_is_checked(frames: int) -> None:
    with pytest.raises(ValueError, match="frames must be from 1 to 80"):
        run_demo(0, frames=frames)


@pytest.mark.parametrize("as_json", [True, False])
def test_the_command_writes_its_files(
    as_json: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("cobevglue.demo.run_demo", partial(run_demo, frames=5))
    out = tmp_path / "new" / "folder"
    assert main(["demo", "--out", str(out), *(["--json"] if as_json else [])]) == 0
    printed = capsys.readouterr().out
    assert sorted(path.name for path in out.iterdir()) == sorted(FILES)
    if as_json:
        report = json.loads(printed)
        assert [Path(file).name for file in report["files"]] == list(FILES)
        assert report["frames"] == 5
    else:
        assert all(name in printed for name in POSE_SOURCES.values())
        assert str(out / "index.html") in printed
    page = (out / "index.html").read_text(encoding="utf-8")
    assert page.count('src="data:image/') == 4
    assert "http" not in page.split("<body>")[1].replace("data:image", ""), "nothing is loaded from anywhere"


def test_a_folder_that_cannot_be_made_is_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("cobevglue.demo.run_demo", partial(run_demo, frames=2))
    (tmp_path / "file").write_text("in the way")
    assert main(["demo", "--out", str(tmp_path / "file" / "out")]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines()[-1].startswith("error: ")
