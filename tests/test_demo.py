"""The demonstration: what it compares, that CoBEVGlue gets clouds only, and what it writes."""

from __future__ import annotations

import json
import math
import re
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cobevglue import SE2, Alignment, BEVGlue, Boxes, CoBEVGlue
from cobevglue.cli import main
from cobevglue.demo import COBEVGLUE, EGO_ONLY, MIN_POINTS, ROWS, DemoFrame, DemoResult, run_demo
from cobevglue.evaluation.detection import evaluate_detections
from cobevglue.messages import encoded_size
from cobevglue.system import StepOutput

FRAMES = 3
FILES = ("index.html", "comparison.png", "pose.png")


@pytest.fixture(scope="module")
def drive() -> DemoResult:
    return run_demo(0, frames=FRAMES)


# What is counted, on a frame made by hand


def cars(*at: tuple[float, float], score: list[float] | None = None) -> Boxes:
    return Boxes([(x, y, 0.0) for x, y in at], [(4.0, 2.0, 1.5)] * len(at), [0.0] * len(at), score)


SEEN, UNSEEN, PARKED, FAR, THIN, OUTSIDE = range(6)


def frame(boxes: Boxes, alignments: dict[str, Alignment] | None = None) -> DemoFrame:
    """Six vehicles: one that all see, three hidden from the ego, one with too few points, one out of reach."""
    output = StepOutput(boxes, alignments or {}, {}, {}, {})
    return DemoFrame(
        index=0,
        time=0.0,
        ego="car1",
        reach=(-70.0, 70.0, -40.0, 40.0),
        world_SE2_ego=SE2(),
        points={},
        truth=cars((10.0, 0.0), (20.0, 0.0), (15.0, 20.0), (60.0, 20.0), (30.0, -10.0), (90.0, 0.0)),
        point_count=np.array([100, 50, 50, 50, MIN_POINTS - 1, 100]),
        own_point_count=np.array([80, MIN_POINTS - 1, 0, 0, 0, 0]),
        speed=np.array([10.0, 10.0, 0.0, 10.0, 10.0, 10.0]),
        ego_SE2_others={"car2": SE2(5.0, 0.0, 0.0)},
        outputs={COBEVGLUE: output},
    )


def test_evaluated_vehicles_have_points_within_range() -> None:
    made = frame(Boxes.empty())
    assert np.flatnonzero(made.counted).tolist() == [SEEN, UNSEEN, PARKED, FAR]


def test_hidden_vehicles_have_few_ego_points() -> None:
    made = frame(Boxes.empty())
    assert np.flatnonzero(made.hidden).tolist() == [UNSEEN, PARKED, FAR]
    assert made.hidden_movers.tolist() == [UNSEEN], "neither the parked one nor the one 63 m away"


def test_detections_are_split_into_true_and_false() -> None:
    # Found: 10 m and (with half a metre off) 20 m. Not sure enough: the parked one. On one that does not count: 30 m.
    # Ghosts: one in the open, one that overlaps the far one too little, and a second box on the one at 10 m.
    at = [(10.0, 0.0), (20.5, 0.0), (15.0, 20.0), (30.0, -10.0), (-30.0, 0.0), (62.0, 20.0), (10.2, 0.0)]
    verdict = frame(cars(*at, score=[0.9, 0.8, 0.2, 0.7, 0.6, 0.5, 0.4])).verdict(COBEVGLUE)
    assert np.flatnonzero(verdict.found).tolist() == [SEEN, UNSEEN]
    assert verdict.boxes[verdict.ghost].center[:, 0].tolist() == [-30.0, 62.0, 10.2]
    assert len(verdict.boxes) == 5, "all that are sure enough and not on a vehicle that does not count"


def test_refused_poses_are_unused_and_errors_measured() -> None:
    found = {"car2": Alignment(SE2(5.0, 3.0, math.radians(2.0))), "car3": Alignment.refused("no")}
    made = frame(Boxes.empty(), found)
    assert list(made.used_poses(COBEVGLUE)) == ["car2"]
    ((metres, radians),) = made.pose_errors(COBEVGLUE)
    assert metres == pytest.approx(3.0)
    assert math.degrees(radians) == pytest.approx(2.0)


def test_story_frame_has_most_hidden_moving_vehicles() -> None:
    calm = frame(Boxes.empty())
    busy = frame(Boxes.empty())
    object.__setattr__(busy, "speed", np.full(6, 10.0))
    result = DemoResult(0, None, (calm, busy, busy))  # type: ignore[arg-type]
    assert result.story() is result.frames[1]


# The drive


def test_demo_figures_match_their_definitions(drive: DemoResult) -> None:
    summary = drive.summary()
    assert summary["frames"] == FRAMES
    assert summary["vehicles"] == pytest.approx(np.mean([frame.counted.sum() for frame in drive.frames]))
    assert set(summary["rows"]) == set(ROWS)
    for name, row in summary["rows"].items():
        report = evaluate_detections(
            (frame.detections(name) for frame in drive.frames),
            evaluation_range=(-70.4, 70.4, -40.0, 40.0),
            min_points=MIN_POINTS,
        )
        assert (row["ap_0.5"], row["ap_0.7"]) == (report.ap(0.5), report.ap(0.7))
        assert row["found"] == pytest.approx(report.overall.at[0.5].recall * report.overall.truth / FRAMES)
    json.dumps(summary, allow_nan=False)


def test_all_rows_share_clouds_and_feature_messages(drive: DemoResult) -> None:
    rows = drive.summary()["rows"]
    assert rows[EGO_ONLY]["bytes_in_all"] is None, "nobody sends anything"
    features = {name: rows[name]["bytes_in_all"] - rows[name]["bytes_for_pose"] for name in ROWS if name != EGO_ONLY}
    assert len(set(features.values())) == 1
    sizes = [encoded_size(len(frame.tracked[name]), name) for frame in drive.frames for name in frame.ego_SE2_others]
    assert rows[COBEVGLUE]["bytes_for_pose"] == pytest.approx(np.mean(sizes))


def test_poses_are_exact_attacked_or_noisy_as_set(drive: DemoResult) -> None:
    rows = drive.summary()["rows"]
    assert rows["true_pose"]["median_error_m"] == pytest.approx(0.0, abs=1e-9)
    attacked = [pose for frame in drive.frames for pose in frame.used_poses("attacked_gps").values()]
    np.testing.assert_allclose([pose.matrix() for pose in attacked], np.tile(np.eye(3), (2 * FRAMES, 1, 1)), atol=1e-9)
    assert 0.5 < rows["noisy_gps"]["median_error_m"] < 8.0


def test_ego_only_row_uses_ego_detections_only(drive: DemoResult) -> None:
    for frame in drive.frames:
        assert frame.outputs[EGO_ONLY].alignments == {}
        assert frame.outputs[EGO_ONLY].message_bytes == {}


def test_something_is_hidden_from_the_ego_and_driving(drive: DemoResult) -> None:
    assert drive.summary()["hidden_from_ego"] >= 3
    assert len(drive.story().hidden_movers) >= 1


def test_cobevglue_gets_clouds_and_no_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    given: list[tuple[str, bool]] = []
    aligned: list[tuple[Any, ...]] = []
    collaborate, align = CoBEVGlue.collaborate, BEVGlue.align

    def watched(self: CoBEVGlue, seen: Any, ego: str, time: Any, poses: Any, seconds: Any) -> StepOutput:
        given.append((type(self.aligner).__name__, poses is not None))
        return collaborate(self, seen, ego, time, poses, seconds)

    def watched_align(self: BEVGlue, *arguments: Any) -> Alignment:
        aligned.append(arguments)
        return align(self, *arguments)

    monkeypatch.setattr(CoBEVGlue, "collaborate", watched)
    monkeypatch.setattr(BEVGlue, "align", watched_align)
    run_demo(0, frames=1)
    assert sorted(given) == [("GivenLocalisation", True)] * 4 + [("Pairwise", False)]
    assert aligned
    assert all([type(argument) for argument in arguments] == [Boxes, Boxes, float] for arguments in aligned)


def test_the_same_seed_gives_the_same_drive() -> None:
    first, again, different = (run_demo(seed, frames=1).summary() for seed in (3, 3, 4))
    for summary in (first, again, different):
        summary.pop("median_ms")
    assert first == again
    assert first["rows"] != different["rows"]


@pytest.mark.parametrize(
    ("seed", "frames", "what"), [(0, 0, "frames must be"), (0, 201, "frames must"), (-1, 1, "seed")]
)
def test_out_of_range_values_are_refused(seed: int, frames: int, what: str) -> None:
    with pytest.raises(ValueError, match=what):
        run_demo(seed, frames=frames)


# The command


@pytest.mark.parametrize("as_json", [True, False])
def test_the_command_writes_its_files(
    as_json: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("cobevglue.demo.run_demo", partial(run_demo, frames=2))
    out = tmp_path / "new" / "folder"
    assert main(["demo", "--out", str(out), *(["--json"] if as_json else [])]) == 0
    printed = capsys.readouterr().out
    assert sorted(path.name for path in out.iterdir()) == sorted(FILES)
    if as_json:
        report = json.loads(printed)
        assert [Path(file).name for file in report["files"]] == list(FILES)
        assert report["frames"] == 2
    else:
        assert all(name in printed for name in ROWS.values())
        assert str(out / "index.html") in printed
    page = (out / "index.html").read_text(encoding="utf-8")
    assert page.count('src="data:image/') == 2
    assert "http" not in re.sub(r"data:[^\"]*", "", page.split("<body>")[1]), "nothing is loaded from anywhere"


def test_unwritable_folder_is_one_line_before_work(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "file").write_text("in the way")
    assert main(["demo", "--out", str(tmp_path / "file" / "out")]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.splitlines()[-1].startswith("error: ")
    assert "frames" not in err


@pytest.mark.parametrize(
    ("missing", "extras"),
    [
        (["torch"], "perception"),
        (["libsumo", "embreex"], "simulation"),
        (["torch", "trimesh"], "perception,simulation"),
    ],
)
def test_missing_package_error_names_its_extra(
    missing: list[str], extras: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("cobevglue.cli.demo.find_spec", lambda name: None if name in missing else name)
    assert main(["demo"]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert line == f"error: the demonstration needs {', '.join(missing)}: pip install 'cobevglue[{extras}]'"
