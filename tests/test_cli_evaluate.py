"""`cobevglue evaluate` on a simulated junction in OPV2V's format."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cobevglue.cli import main


def test_it_prints_one_document_with_all_frames(junction_tree: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "--root", str(junction_tree), "--perfect", "--json"]) == 0
    captured = capsys.readouterr()
    groups = json.loads(captured.out)
    assert groups["all"]["frames"] == 12
    assert groups["all"]["wrong_of_accepted"] in (0.0, None)  # perfect boxes are never matched wrongly here
    assert "junction" in captured.err  # progress goes to standard error


def test_the_table_has_a_row_for_each_group(junction_tree: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "--root", str(junction_tree), "--paper"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert any(line.split()[:2] == ["all", "12"] for line in lines)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["--root", "nowhere"], "nowhere"),  # a root that is not there
        (["--root", "{root}", "--split", "tset"], "did you mean 'test'"),  # a split with a typing error
        (["--root", "{root}", "--task", "sing"], "align"),  # a task that does not exist
        (["--root", "{root}", "--max-range", "-3"], "max-range"),  # a negative range
    ],
)
def test_bad_input_is_one_line(
    junction_tree: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    assert main(["evaluate", *(word.replace("{root}", str(junction_tree)) for word in arguments)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert said in captured.err
    assert len(captured.err.splitlines()) == 1
