"""`cobevglue reproduce --quick`, on fewer frames: every table of every method, on the shipped weights."""

from __future__ import annotations

import contextlib
import io
import json
from typing import Any

import pytest

from cobevglue.cli import main
from cobevglue.fusion import FUSION_METHODS

Rows = dict[str, dict[str, Any]]


def rows_of(table: dict[str, Any]) -> Rows:
    """The rows by their first cell, each by column."""
    return {row[0]: dict(zip(table["columns"], row, strict=True)) for row in table["rows"]}


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Rows]:
    """By name, of a study of simulated sequences."""
    pytest.importorskip("libsumo")
    out = tmp_path_factory.mktemp("quick")
    with contextlib.redirect_stdout(io.StringIO()) as printed:
        assert main(["reproduce", "--quick", "--frames", "2", "--workers", "1", "--out", str(out), "--json"]) == 0
    assert (out / "index.html").is_file()
    assert (out / "report.md").is_file()
    return {table["name"]: rows_of(table) for table in json.loads(printed.getvalue())["tables"]["simulated test"]}


def test_every_table_is_there(tables: dict[str, Rows]) -> None:
    assert {"noise_ap0.5", "noise_ap0.7", "attack", "registration", "ablation", "poses", "communication"} <= set(tables)
    assert len(tables["noise_ap0.5"]) == len(FUSION_METHODS) + 2  # and its fusion on given and on true poses


@pytest.mark.parametrize("title", ["CoBEVGlue", "No collaboration", "True pose, CoBEVGlue's fusion"])
def test_noise_has_no_effect_without_claimed_poses(tables: dict[str, Rows], title: str) -> None:
    row = tables["noise_ap0.5"][title]
    assert row["0.0/0.0"] == row["2.5/2.5"]


def test_it_pays_to_see_together(tables: dict[str, Rows]) -> None:
    rows = tables["noise_ap0.5"]
    alone = rows["No collaboration"]["0.0/0.0"]
    assert rows["True pose, CoBEVGlue's fusion"]["0.0/0.0"] > alone + 0.02
    assert rows["CoBEVGlue"]["2.5/2.5"] > alone
    given = rows["Given pose, CoBEVGlue's fusion"]
    assert given["2.5/2.5"] < given["0.0/0.0"] - 0.02


def test_compression_saves_bytes_and_keeps_precision(tables: dict[str, Rows]) -> None:
    rows = tables["bandwidth"]  # of a method the last row, which is compressed
    row = rows["CoBEVGlue"]
    assert (row["bits"], row["cells"]) == (3, 0.05)
    assert row["bytes"] < 0.02 * tables["communication"]["CoBEVGlue"]["bytes"]
    assert row["AP@0.5"] > rows["No collaboration"]["AP@0.5"]


def test_bevglue_adds_few_bytes(tables: dict[str, Rows]) -> None:
    row = tables["communication"]["CoBEVGlue"]
    assert 0.0 < row["bytes for alignment"] < 1e-3 * row["bytes"]
