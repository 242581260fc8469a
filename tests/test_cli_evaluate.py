"""`cobevglue evaluate` on a tree that `cobevglue simulate` wrote."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from cobevglue.cli import main


@pytest.fixture(scope="module")
def simulated(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Twelve frames of two agents in OPV2V's format."""
    root = tmp_path_factory.mktemp("simulated")
    assert main(["simulate", str(root), "--frames", "12", "--seed", "2"]) == 0
    return root


def test_it_prints_one_document_with_all_frames(simulated: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "--root", str(simulated), "--perfect", "--json"]) == 0
    captured = capsys.readouterr()
    groups = json.loads(captured.out)
    assert groups["all"]["frames"] == 12
    assert groups["all"]["wrong_of_accepted"] in (0.0, None)  # perfect boxes are never matched wrongly here
    assert "junction" in captured.err  # progress goes to standard error


def test_the_table_has_a_row_for_each_group(simulated: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", "--root", str(simulated), "--paper"]) == 0
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
    simulated: Path, capsys: pytest.CaptureFixture[str], arguments: list[str], said: str
) -> None:
    assert main(["evaluate", *(word.replace("{root}", str(simulated)) for word in arguments)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert said in captured.err
    assert len(captured.err.splitlines()) == 1
