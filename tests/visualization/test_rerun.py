"""Recordings for the Rerun viewer: written by the real SDK, and read back by its command line."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from cobevglue import SE2, Alignment, Boxes
from cobevglue.visualization.rerun import log_frame, open_recording

pytest.importorskip("rerun")

EGO = Boxes([(10, 0, 0), (20, 5, 0)], [(4.5, 1.9, 1.5)] * 2, [0.0, 1.0], track_id=[7, 8], label=["car", "van"])
OTHER = Boxes([(-10, 0, 0)], [(4.5, 1.9, 1.5)], [0.0])
FOUND = Alignment(SE2(20.0, 0.0, 0.0), np.array([[0, 0]]), np.diag([0.01, 0.01, 1e-4]), evidence=12.5, margin=4.0)
REFUSED = Alignment.refused("too few objects")


def printed(path: Path, *options: str) -> str:
    done = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "print", *options, path], capture_output=True, text=True, check=True
    )
    return done.stdout


def rows_by_entity(path: Path) -> dict[str, int]:
    return {
        entity: int(rows)
        for rows, entity in re.findall(r"^Chunk\(\S+ with (\d+) rows? .*? - (/.*) - data columns", printed(path), re.M)
    }


def test_recording_holds_every_frame(tmp_path: Path) -> None:
    path = tmp_path / "drive.rrd"
    with open_recording(path) as recording:
        for time, alignment in enumerate([FOUND, FOUND, REFUSED]):
            log_frame(recording, {"car1": EGO, "car 2": OTHER}, "car1", {"car 2": alignment}, 0.1 * time, fused=EGO)
    rows = rows_by_entity(path)
    assert rows["/agents/car1/boxes"] == rows["/agents/car1/pose"] == rows["/fused"] == 3
    assert rows["/agents/car\\ 2/boxes"] == rows["/agents/car\\ 2/pose"] == rows["/agents/car\\ 2/matches"] == 2
    assert rows["/agents/car\\ 2"] == 1, "a refusal clears what was shown before"
    assert rows["/verdict/car\\ 2"] == rows["/verdict/car\\ 2/accepted"] == 3
    assert rows["/verdict/car\\ 2/evidence"] == rows["/verdict/car\\ 2/position_std"] == 2


def test_values_are_those_logged(tmp_path: Path) -> None:
    path = tmp_path / "one.rrd"
    with open_recording(path) as recording:
        log_frame(recording, {"a": EGO, "b": OTHER}, "a", {"b": FOUND}, 1.5)
    text = printed(path, "-vvv")
    assert "car 7" in text
    assert "van 8" in text
    assert "accepted, 1 matches" in text
    assert "12.5" in text
    assert "0.5729" in text, "0.01 rad in degrees"


def test_refusal_shows_its_reason(tmp_path: Path) -> None:
    path = tmp_path / "refused.rrd"
    with open_recording(path) as recording:
        log_frame(recording, {"a": EGO, "b": OTHER}, "a", {"b": REFUSED}, 0.0)
    assert "refused: too few objects" in printed(path, "-vvv")
    assert "/agents/b/boxes" not in rows_by_entity(path)


def test_frames_without_boxes_or_matches(tmp_path: Path) -> None:
    path = tmp_path / "empty.rrd"
    nothing = Boxes.empty()
    with open_recording(path) as recording:
        log_frame(recording, {"a": nothing, "b": nothing}, "a", {"b": Alignment(SE2())}, 0.0)
    assert rows_by_entity(path)["/agents/b/boxes"] == 1


@pytest.mark.parametrize(
    ("boxes", "alignments", "name"),
    [
        ({"b": OTHER}, {"b": FOUND}, "'a'"),
        ({"a": EGO, "b": OTHER}, {}, "'b'"),
        ({"a": EGO}, {"c": FOUND}, "'c'"),
    ],
    ids=["the ego has no boxes", "no alignment of an agent", "no boxes of an agent"],
)
def test_incomplete_frame_names_the_agent(
    tmp_path: Path, boxes: dict[str, Boxes], alignments: dict[str, Alignment], name: str
) -> None:
    with open_recording(tmp_path / "a.rrd") as recording, pytest.raises(ValueError, match=f"agent {name} must have"):
        log_frame(recording, boxes, "a", alignments, 0.0)


def test_absent_folder_is_named(tmp_path: Path) -> None:
    with (
        pytest.raises(FileNotFoundError, match="nowhere does not exist"),
        open_recording(tmp_path / "nowhere" / "a.rrd"),
    ):
        pass


def test_rerun_is_imported_on_first_use() -> None:
    code = "import sys, cobevglue.visualization.rerun; sys.exit('rerun' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], check=False).returncode == 0
