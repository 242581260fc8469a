"""`cobevglue reproduce`: a report from one command, and errors in one line."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import pytest
from typer.main import get_command

from cobevglue.cli import main
from cobevglue.cli.app import app
from cobevglue.cli.reproduce import _command

from .tiny import write_agent


def reproduce(tiny: Path, out: Path, *more: str) -> int:
    """With the tiny data and detector."""
    data = ["--dataset", "opv2v", "--root", str(tiny / "data")]
    network = ["--detector", str(tiny / "tiny.safetensors"), "--untrained", "--workers", "1"]
    return main(["reproduce", "--quick", "--out", str(out), *data, *network, *more])


def test_one_command_writes_a_report_that_says_which(
    tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "a report"
    assert reproduce(tiny, out, "--tables", "communication, time", "--frames", "2", "--seed", "7") == 0
    printed = capsys.readouterr()
    assert "AP@0.5, no collaboration" not in printed.out  # was not asked for
    assert "evaluated objects" in printed.out
    assert str(out / "index.html") in printed.out
    report = (out / "report.md").read_text()
    assert "Command: cobevglue reproduce --quick --dataset opv2v --root" in report
    assert "--frames 2 --seed 7" in report
    assert "Seed: 7" in report
    for word in ("torch 2", "python 3", "Machine: ", "Date: 20", "global AP", "without any training"):
        assert word in report
    assert (out / "index.html").is_file()
    assert sorted(path.name for path in (out / "opv2v_test").glob("*.csv")) == [
        "communication.csv",
        "time.csv",
        "time_perception.csv",
    ]


def test_json_has_every_table_and_nothing_else(tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert reproduce(tiny, tmp_path, "--tables", "communication", "--frames", "1", "--json") == 0
    document = json.loads(capsys.readouterr().out)
    assert [table["name"] for table in document["tables"]["opv2v test"]] == ["communication"]
    assert document["tables"]["summary"][0]["columns"] == ["", "opv2v test"]
    (table,) = document["tables"]["opv2v test"]
    assert all(len(row) == len(table["columns"]) for row in table["rows"])
    assert document["studies"][0]["frames"] == 1


def test_a_second_data_set_stands_beside(tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for agent in (1, 2):
        write_agent(tmp_path / "real" / "test_culvercity" / "sequence", agent, range(1))
    real = ("--real", str(tmp_path / "real"), "--tables", "communication", "--frames", "1", "--json")
    assert reproduce(tiny, tmp_path / "out", *real) == 0
    tables = json.loads(capsys.readouterr().out)["tables"]
    assert tables["summary"][0]["columns"] == ["", "opv2v test", "opv2v test_culvercity"]
    assert [table["name"] for table in tables["opv2v test_culvercity"]] == ["communication"]


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--methods", "f-cooper,colaign"), "no fusion method 'colaign'; did you mean 'coalign'"),
        (("--tables", "noise,atack"), "no table 'atack'; did you mean 'attack'"),
        (("--dataset", "opv2w"), "no data set 'opv2w'; did you mean 'opv2v'"),
        (("--split", "tset"), "no split 'tset'; did you mean 'test'"),
        (("--root", "/nowhere"), "no folder /nowhere"),
        (("--detector", "compakt"), "no pretrained detector 'compakt'; did you mean 'compact'"),
        (("--dataset", "simulated"), "simulated sequences have no root"),
        (("--dataset", "dair-v2x"), "looked for"),
        (("--frames", "0"), "--frames"),
        (("--real", "/nowhere"), "no folder /nowhere"),
    ],
)
def test_bad_input_is_one_line_and_exits_2(
    tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...], message: str
) -> None:
    assert reproduce(tiny, tmp_path / "out", "--tables", "communication", *words) == 2
    printed = capsys.readouterr()
    assert printed.out == ""
    (line,) = printed.err.strip().splitlines()
    assert line.startswith("error: ")
    assert message in line


def test_a_folder_with_another_study_is_refused(tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert reproduce(tiny, tmp_path, "--tables", "communication", "--frames", "1") == 0
    assert reproduce(tiny, tmp_path, "--tables", "communication", "--frames", "1", "--seed", "9") == 2
    assert "results of another study (seed 2406, not 9)" in capsys.readouterr().err


def test_without_weights_the_method_is_named(tiny: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    data = ["--dataset", "opv2v", "--root", str(tiny / "data"), "--detector", str(tiny / "tiny.safetensors")]
    assert main(["reproduce", "--quick", "--out", str(tmp_path), *data]) == 2
    assert "no pretrained weights of" in capsys.readouterr().err


def test_real_clouds_go_through_the_shipped_detector(
    culver_city: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["--dataset", "opv2v", "--root", str(culver_city), "--split", "test_culvercity", "--frames", "3"]
    more = ["--tables", "ablation", "--untrained", "--workers", "1", "--scenarios", "2", "--json"]
    assert main(["reproduce", "--quick", "--out", str(tmp_path), *words, *more]) == 0
    tables = json.loads(capsys.readouterr().out)["tables"]
    rows = {row[0]: row[1] for row in tables["summary"][0]["rows"]}
    assert rows["frames"] == 2  # the first one, and those of ThreeCars_1, have no clouds
    assert rows["AP@0.5, no collaboration"] > 0.3
    (ablation,) = tables["opv2v test_culvercity"]
    ours = dict(zip(ablation["columns"], ablation["rows"][4], strict=True))
    assert ours["refused"] <= 0.5
    assert ours["AP@0.5"] > rows["AP@0.5, no collaboration"]


def test_the_recorded_command_repeats_repeated_options() -> None:
    words = ["--quick", "--dataset-option", "labels=original", "--dataset-option", "split_file=my ids.json"]
    command: Any = get_command(app)
    context = command.commands["reproduce"].make_context("cobevglue reproduce", list(words))
    recorded = "--dataset-option labels=original --dataset-option 'split_file=my ids.json'"
    assert _command(context) == f"cobevglue reproduce --quick {recorded}"


def test_reader_options_are_refused_for_simulated_drives(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["reproduce", "--out", str(tmp_path), "--dataset-option", "labels=original"]) == 2
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert "have no effect on simulated sequences: {'labels': 'original'}" in line
