"""The command line: exit codes, one line for what goes wrong, and nothing but JSON on standard output with --json."""

from __future__ import annotations

import json
import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import cobevglue
from cobevglue import SE2, Boxes
from cobevglue.cli import main
from cobevglue.messages import to_dict, write_object_list

COMMANDS = ("demo", "align", "simulate", "bench")
EGO = Boxes(
    center=[(12, 3, 0), (25, -4, 0), (-8, 7, 0), (19, 15, 0), (31, 9, 0), (5, -12, 0), (-20, -9, 0)],
    size=[(4.5, 1.9, 1.5), (4.2, 1.8, 1.5), (9.1, 2.5, 3.0), (4.7, 1.9, 1.5), (5.4, 2.0, 2.0), (4.3, 1.8, 1.5)]
    + [(11.8, 2.5, 3.1)],
    yaw=[0.0, 3.1, 0.1, 1.6, -1.5, -1.6, 0.8],
    track_id=range(7),
)
EGO_SE2_OTHER = SE2(20.0, 6.0, 1.5)
OTHER = EGO.transform(EGO_SE2_OTHER.inverse())[::-1]
GOOD_ROW: dict[str, Any] = {"x": 1.0, "y": 2.0, "l": 4.5, "w": 1.9, "yaw": 0.1}


def in_subprocess(*words: object) -> subprocess.CompletedProcess[str]:
    """Run the program as a user does."""
    command = [sys.executable, "-m", "cobevglue.cli", *map(str, words)]
    return subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)


@pytest.fixture
def lists(tmp_path: Path) -> tuple[Path, Path]:
    ego, other = tmp_path / "ego.json", tmp_path / "other.json"
    write_object_list(ego, EGO)
    write_object_list(other, OTHER)
    return ego, other


# The program


def test_help_lists_all_commands() -> None:
    done = in_subprocess("--help")
    assert (done.returncode, done.stderr) == (0, "")
    assert all(command in done.stdout for command in COMMANDS)


@pytest.mark.parametrize("command", COMMANDS)
def test_every_command_has_help(command: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main([command, "--help"]) == 0
    assert "--json" in capsys.readouterr().out


def test_the_version_is_printed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--version"]) == 0
    assert capsys.readouterr().out == f"cobevglue {cobevglue.__version__}\n"


def test_no_command_shows_help_and_exits_2(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([]) == 2
    assert "Usage" in capsys.readouterr().out


USAGE_ERRORS = [
    (["alihn"], "No such command 'alihn'"),
    (["--nosuch"], "--nosuch"),
    (["align", "--nosuch"], "--nosuch"),
    (["align"], "Missing argument"),
    (["align", "-1/000070.yaml", "b.json"], "a path that begins with a dash as ./-1/…"),
    (["align", "a.json", "b.json", "c.json"], "c.json"),
    (["demo", "--seed", "-1"], "--seed"),
    (["demo", "--seed", "x"], "--seed"),
    (["simulate", "out", "--format", "kitti"], "--format"),
    (["simulate", "out", "--agents", "9"], "--agents"),
]


@pytest.mark.parametrize(("words", "named"), USAGE_ERRORS)
def test_wrong_usage_is_one_line_that_names_it(
    words: list[str], named: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("error: ")
    assert err.count("\n") == 1
    assert named in err


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from cobevglue.cli import main; main(['--help']); "
        "print([m for m in ('numba', 'matplotlib', 'scipy', 'torch', 'yaml') if m in sys.modules], file=sys.stderr)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stderr == "[]\n"


def test_interruption_exits_130_with_one_line(
    lists: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("cobevglue.cli.object_files.read_pairs", interrupted)
    assert main(["align", *map(str, lists)]) == 130
    assert capsys.readouterr() == ("", "interrupted\n")


@pytest.mark.parametrize("bug", [TypeError, AssertionError, KeyError])
def test_a_bug_keeps_its_traceback(
    bug: type[Exception], lists: tuple[Path, Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object, **__: object) -> None:
        raise bug

    monkeypatch.setattr("cobevglue.alignment.BEVGlue.align", broken)
    with pytest.raises(bug):
        main(["align", *map(str, lists)])


# align


def test_align_prints_pose_and_verdict(lists: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["align", *map(str, lists)]) == 0
    out, err = capsys.readouterr()
    assert err == ""
    assert all(part in out for part in ("accepted", "20.0", "6.0", "85.9", "7 of 7 and 7"))


def test_align_json_prints_one_document(lists: tuple[Path, Path]) -> None:
    done = in_subprocess("align", *lists, "--json")
    assert (done.returncode, done.stderr) == (0, "")
    found = json.loads(done.stdout)
    assert (found["accepted"], found["reason"]) == (True, "")
    pose = found["ego_SE2_other"]
    assert [pose["x"], pose["y"], pose["yaw"]] == pytest.approx([20.0, 6.0, 1.5], abs=0.02)
    assert pose["yaw_deg"] == pytest.approx(math.degrees(pose["yaw"]))
    assert sorted(found["matches"]) == [[i, 6 - i] for i in range(7)]
    assert np.linalg.eigvalsh(found["covariance"]).min() > 0
    assert found["evidence"] >= found["margin"] > 0


def test_refusal_exits_3_with_reason_and_no_pose(tmp_path: Path, lists: tuple[Path, Path]) -> None:
    nothing = tmp_path / "nothing.json"
    write_object_list(nothing, Boxes.empty())
    done = in_subprocess("align", lists[0], nothing, "--json")
    assert (done.returncode, done.stderr) == (3, "")
    found = json.loads(done.stdout)
    assert found["accepted"] is False
    assert found["reason"]
    assert found["ego_SE2_other"] is found["covariance"] is None
    assert found["matches"] == []


def test_refusal_reason_is_in_the_table(
    tmp_path: Path, lists: tuple[Path, Path], capsys: pytest.CaptureFixture[str]
) -> None:
    nothing = tmp_path / "nothing.json"
    write_object_list(nothing, Boxes.empty())
    assert main(["align", str(lists[0]), str(nothing)]) == 3
    out = capsys.readouterr().out
    assert "refused" in out
    assert "reason" in out


def test_the_papers_settings_align_too(lists: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["align", *map(str, lists), "--paper", "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["ego_SE2_other"]["x"] == pytest.approx(20.0, abs=0.02)


def test_align_draws_a_picture(lists: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = tmp_path / "new folder" / "result.png"
    assert main(["align", *map(str, lists), "--picture", str(picture), "--json"]) == 0
    assert picture.read_bytes().startswith(b"\x89PNG")
    out, err = capsys.readouterr()
    json.loads(out)
    assert str(picture) in err


BAD_FILES: list[tuple[str, str, str | None, str]] = [
    ("a file that is not there", "lost.json", None, "No such file"),
    ("text that is no JSON", "ego.json", "boxes: none", "not JSON"),
    ("NaN", "ego.json", json.dumps({"boxes": [{**GOOD_ROW, "x": math.nan}]}), "row 0: x must be a finite number"),
    ("a negative length", "ego.json", json.dumps({"boxes": [GOOD_ROW, {**GOOD_ROW, "l": -1}]}), "size: row 1"),
    ("an id twice", "ego.json", json.dumps({"boxes": [{**GOOD_ROW, "track_id": 7}] * 2}), "track_id: rows 0 and 1"),
    ("a misspelt key", "ego.json", json.dumps({"boxes": [{**GOOD_ROW, "headin": 0}]}), "nearest valid key"),
    ("another ending", "ego.txt", json.dumps({"boxes": [GOOD_ROW]}), ".json"),
    ("a frame of OPV2V without its pose", "000068.yaml", "vehicles: {}\n", "lidar_pose"),
]


@pytest.mark.parametrize(("what", "name", "text", "said"), BAD_FILES, ids=[case[0] for case in BAD_FILES])
def test_bad_input_names_file_and_place(
    what: str,
    name: str,
    text: str | None,
    said: str,
    tmp_path: Path,
    lists: tuple[Path, Path],
    capsys: pytest.CaptureFixture[str],
) -> None:
    bad = tmp_path / "bad" / name
    if text is not None:
        bad.parent.mkdir()
        bad.write_text(text)
    for words in ([str(bad), str(lists[1])], [str(lists[1]), str(bad), "--json"]):
        assert main(["align", *words]) == 2
        out, err = capsys.readouterr()
        assert out == "", what
        assert err.count("\n") == 1
        assert err.startswith("error: ")
        assert name in err
        assert said in err


def test_bad_input_shows_no_traceback(tmp_path: Path) -> None:
    done = in_subprocess("align", tmp_path / "a.json", tmp_path / "b.json", "--json")
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"error: {tmp_path / 'a.json'}: No such file or directory\n"


def test_unknown_picture_format_is_refused_first(lists: tuple[Path, Path], capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["align", *map(str, lists), "--picture", "result.doc"]) == 2
    out, err = capsys.readouterr()
    assert out == ""
    assert "result.doc" in err
    assert ".png" in err


def test_unwritable_picture_is_one_error_line(
    lists: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").write_text("in the way")
    assert main(["align", *map(str, lists), "--picture", str(tmp_path / "file" / "a.png")]) == 2
    assert capsys.readouterr().err.count("\n") == 1


# align, over time


def write_folders(root: Path, ego_names: list[str], other_names: list[str], with_ids: bool = True) -> tuple[Path, Path]:
    """Folders in which every frame is the same."""
    folders = root / "ego", root / "other"
    for folder, names, boxes in zip(folders, (ego_names, other_names), (EGO, OTHER), strict=True):
        folder.mkdir()
        for name in names:
            write_object_list(folder / name, boxes if with_ids else boxes.replace(track_id=None))
    return folders


@pytest.mark.parametrize("with_ids", [True, False])
def test_folders_are_paired_by_name_with_gaps(
    with_ids: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    folders = write_folders(tmp_path, ["8.json", "9.json", "10.json", "11.json"], ["8.json", "10.json"], with_ids)
    assert main(["align", *map(str, folders), "--json"]) == 0
    out, err = capsys.readouterr()
    found = json.loads(out)
    assert [frame["name"] for frame in found["frames"]] == ["8", "10"]
    assert [frame["time"] for frame in found["frames"]] == pytest.approx([0.0, 0.2])
    assert {key: found["frames"][-1][key] for key in found if key != "frames"} == {
        key: found[key] for key in found if key != "frames"
    }, "the verdict is the last frame's"
    assert "2 of 4 frames" in err


def test_folders_print_a_line_for_each_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folders = write_folders(tmp_path, ["a.json", "b.json"], ["a.json", "b.json"])
    assert main(["align", *map(str, folders)]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in lines if line.endswith("accepted ")] == ["a", "b"]


FOLDER_ERRORS: list[tuple[str, Callable[[Path], tuple[Path, Path]], str]] = [
    ("a folder and a file", lambda p: (p / "ego", p / "ego" / "1.json"), "two folders"),
    ("a folder and nothing", lambda p: (p / "ego", p / "lost"), "No such file"),
    ("no common name", lambda p: (p / "ego", p / "other"), "no frame"),
    ("a folder without object lists", lambda p: (p / "ego", p), "no object lists"),
]


@pytest.mark.parametrize(("what", "words", "said"), FOLDER_ERRORS, ids=[case[0] for case in FOLDER_ERRORS])
def test_folders_that_do_not_fit(
    what: str,
    words: Callable[[Path], tuple[Path, Path]],
    said: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    write_folders(tmp_path, ["1.json"], ["2.json"])
    assert main(["align", *map(str, words(tmp_path))]) == 2, what
    assert said in capsys.readouterr().err


# bench


@pytest.mark.parametrize("as_json", [True, False])
def test_bench_times_every_step(
    as_json: bool, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("cobevglue.cli.measure.OBJECT_COUNTS", (5, 8))
    monkeypatch.setattr("cobevglue.cli.measure._FRAMES", 7)
    monkeypatch.setattr("cobevglue.cli.measure._PAPER_OBJECTS_AT_MOST", 5)
    monkeypatch.setattr("cobevglue.cli.measure_perception.CLOUDS", 2)
    assert main(["bench", *(["--json"] if as_json else [])]) == 0
    out = capsys.readouterr().out
    if not as_json:
        assert "BEVGlue, first frame, median" in out
        assert "backbone" in out
        return
    report = json.loads(out)
    assert report["message_bytes"] == {"5": 44 + 5 * 32, "8": 44 + 8 * 32}
    stages = report["perception"]["stages"]
    assert list(stages) == ["load", "pillars", "backbone", "head", "boxes", "heading", "tracking", "all"]
    assert all(0 < timed["best_ms"] <= timed["median_ms"] for timed in stages.values())
    assert report["perception"]["points"] > 10_000
    assert report["perception"]["weights"] == "compact"
    for step, timed in report["steps"].items():
        assert 0 < timed["5"]["best_ms"] <= timed["5"]["median_ms"]
        assert timed["5"]["repeats"] >= 1
        assert (timed["8"] is None) == step.startswith("paper"), "what would take too long is left out, and said so"


def test_bench_with_missing_weights_is_one_line(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "--weights", "compcat"]) == 2
    assert "compcat" in capsys.readouterr().err.splitlines()[-1]


def test_api_object_list_is_valid_input(tmp_path: Path) -> None:
    path = tmp_path / "a.json"
    path.write_text(json.dumps(to_dict(EGO)))
    assert main(["align", str(path), str(path), "--json"]) == 0
