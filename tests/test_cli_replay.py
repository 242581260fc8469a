"""`cobevglue replay` and `simulate --format mcap`: what is printed, exit codes, and bad input in one line."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.machinery import ModuleSpec
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("rosbags", reason="recordings need rosbags")

from cobevglue import Boxes
from cobevglue.cli import main
from cobevglue.recordings import new_detection_bag

BOXES = Boxes([(10, 2, -1), (20, -5, -0.5)], [(4.5, 1.9, 1.5), (8, 2.5, 3)], [0.3, -3.0])


@pytest.fixture(scope="module")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("drive") / "drive"
    assert main(["simulate", str(folder), "--format", "mcap", "--frames", "15", "--seed", "1"]) == 0
    return folder


def bag(folder: Path, boxes: Boxes = BOXES, **times: list[float]) -> Path:
    """A bag in which each agent has a list of these boxes at its times."""
    with new_detection_bag(folder) as writer:
        for time, agent in sorted((time, agent) for agent, each in times.items() for time in each):
            writer.write(f"/{agent}/objects", time, time, agent, boxes)
    return folder


def test_simulated_drive_is_replayed(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(drive)]) == 0
    printed = capsys.readouterr()
    assert "car2" in printed.out
    assert "15 frames of the ego" in printed.out
    assert printed.err.splitlines()[:2] == [
        "ego: car1 (/car1/objects, 15 messages)",
        "other: car2 (/car2/objects, 15 messages)",
    ]


def test_json_is_one_document(drive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    pytest.importorskip("foxglove", reason="MCAP files for Foxglove need foxglove-sdk")
    words = ["--out", str(tmp_path / "out"), "--ego", "/car2/objects", "--other", "car1/objects", "--json"]
    assert main(["replay", str(drive), *words, "--body", "car1=4.5,1.85", "--body", "car2=4.5,1.85,0.1,0"]) == 0
    document = json.loads(capsys.readouterr().out)
    assert document["ego"] == "car2"
    assert document["frames"] == 15
    assert document["topics"]["car1"]["lists"] == 15
    assert document["agents"]["car1"]["accepted"] >= 10
    assert set(document["agents"]["car1"]["last"]) >= {"accepted", "risk", "time_offset", "ego_SE2_other"}
    assert Path(document["files"][0]).name == "index.html"
    assert all(Path(file).exists() for file in document["files"])


def test_refused_in_every_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    one = BOXES[:1]
    assert main(["replay", str(bag(tmp_path / "bag", one, a=[1.0, 1.1], b=[1.0, 1.1]))]) == 3
    assert "0 (0 %)" in capsys.readouterr().out


def test_problems_are_reported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "bag"
    with new_detection_bag(folder) as writer:
        for received, stamp in ((1.0, 1.0), (1.1, 1.1), (1.2, 1.05), (1.3, 1.1), (1.4, 1.4)):
            for agent in "ba":
                writer.write(f"/{agent}/objects", received, stamp, agent, BOXES)
    main(["replay", str(folder)])
    told = capsys.readouterr().err
    assert "/a/objects: 1 lists came after a newer one and are not used" in told
    assert "/b/objects: 1 lists have the time stamp of the one before and are not used" in told


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--ego", "/car7/objects"], "there is no topic '/car7/objects'; there are /car1/objects"),
        (["--ego", "/car1/objects", "--other", "/car1/objects"], "given twice"),
        (["--other", "/car1/objects"], "give the topic of the ego, too (--ego)"),
        (["--max-age", "0"], "max_age must be > 0"),
        (["--max-age", "0.001"], "received up to 0.001 s before it (--max-age)"),
        (["--body", "car9=4,2"], "--body: there is no agent 'car9'"),
        (["--body", "car1=4"], "--body: must be AGENT=LENGTH,WIDTH or"),
        (["--body", "car1=4,-2"], "--body: must be AGENT=LENGTH,WIDTH or"),
        (["--frame", "car9=base_link"], "--frame: there is no agent 'car9'"),
        (["--frame", "car1=lidar"], "message 1 (received at 1700000000.050 s): frame_id: this is in the frame 'car1'"),
        (["--rerun"], "--rerun: needs a folder (--out)"),
    ],
    ids=lambda value: " ".join(value) if isinstance(value, list) else "",
)
def test_bad_options_are_named(drive: Path, capsys: pytest.CaptureFixture[str], words: list[str], message: str) -> None:
    assert main(["replay", str(drive), *words]) == 2
    last = capsys.readouterr().err.splitlines()[-1]
    assert last.startswith("error: ")
    assert message in last


@pytest.mark.parametrize(
    ("boxes", "times", "message"),
    [
        (Boxes.empty(), {"a": [1.0], "b": [1.0]}, "no objects in any of the 1 lists on /a/objects"),
        (BOXES, {"a": [1.0], "b": [9.0]}, "none of the 1 lists on /a/objects has a list on /b/objects"),
        (BOXES, {"a": [1.0]}, "name the agents' topics (--ego, --other)"),
    ],
    ids=["no objects", "nothing at the same time", "one agent"],
)
def test_nothing_to_align(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], boxes: Boxes, times: Any, message: str
) -> None:
    assert main(["replay", str(bag(tmp_path / "bag", boxes, **times))]) == 2
    assert message in capsys.readouterr().err.splitlines()[-1]


def test_file_without_recording_is_an_error(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["replay", str(tmp_path / "nowhere.mcap")]) == 2
    (tmp_path / "text.mcap").write_text("hello" * 50)
    assert main(["replay", str(tmp_path / "text.mcap")]) == 2
    first, second = capsys.readouterr().err.splitlines()
    assert "nowhere.mcap" in first
    assert "text.mcap: this is no MCAP file" in second


def test_existing_folder_is_kept(drive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["simulate", str(drive), "--format", "mcap"]) == 2
    assert "exists already" in capsys.readouterr().err


@pytest.mark.parametrize("words", [["--roadside-units", "1"], ["--lidar", "beams16"], ["--labels-only"]])
def test_options_that_mcap_has_not(tmp_path: Path, capsys: pytest.CaptureFixture[str], words: list[str]) -> None:
    assert main(["simulate", str(tmp_path / "x"), "--format", "mcap", *words]) == 2
    assert f"{words[0]}: not for --format mcap" in capsys.readouterr().err


@pytest.mark.skipif(sys.platform == "win32", reason="limits of file sizes are of POSIX")
def test_full_disk_while_simulating(tmp_path: Path) -> None:
    code = (
        "import resource, sys; resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096));"
        "from cobevglue.cli import main; sys.exit(main(sys.argv[1:]))"
    )
    words = ["simulate", str(tmp_path / "drive"), "--format", "mcap", "--frames", "40"]
    done = subprocess.run([sys.executable, "-B", "-c", code, *words], capture_output=True, text=True, check=False)
    assert done.returncode == 2
    assert done.stderr == f"error: {tmp_path / 'drive'}: File too large\n"


def test_same_seed_gives_the_same_bag(tmp_path: Path) -> None:
    for name in ("one/drive", "two/drive"):
        assert main(["simulate", str(tmp_path / name), "--format", "mcap", "--frames", "3", "--seed", "4"]) == 0
    files = [(tmp_path / name / "drive" / "drive.mcap").read_bytes() for name in ("one", "two")]
    assert files[0] == files[1]
    assert len(files[0]) < 30_000


def test_missing_library_is_named(
    drive: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def find(name: str, package: str | None = None) -> ModuleSpec | None:
        return None

    monkeypatch.setattr("cobevglue.cli.replay.find_spec", find)
    assert main(["replay", str(drive)]) == 2
    assert capsys.readouterr().err.splitlines()[-1] == "error: replay needs rosbags: pip install 'cobevglue[ros]'"
