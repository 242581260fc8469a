"""A study as a page: its text, tables and figures, in order, in one file."""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from cobevglue.experiments.table import Table
from cobevglue.visualization.study_figures import ap_over_noise
from cobevglue.visualization.study_report import Section, write_report

TABLE = Table(
    "noise",
    "AP over noise <here>",
    ["method", "0 m", "2.5 m"],
    [["ego only", 0.7, 0.7], ["CoBEVGlue", 0.91234, math.nan], ["late", 12345, None]],
    ["One note.", "Another."],
)


def written(path: Path, *sections: Section) -> str:
    write_report(path, "A study", sections)
    return path.read_text(encoding="utf-8")


def test_tables_have_their_numbers_titles_and_notes(tmp_path: Path) -> None:
    text = written(tmp_path / "report" / "index.html", Section("Noise", "Words.\n\n    command", [TABLE]))
    assert "<h3>AP over noise &lt;here&gt;</h3>" in text
    assert "<tr><td>ego only</td><td>0.700</td><td>0.700</td></tr>" in text
    assert "<tr><td>late</td><td>12,345</td><td>–</td></tr>" in text
    assert "<li>One note.</li><li>Another.</li>" in text
    assert "<p>Words.</p>\n<pre>command</pre>" in text


def test_the_row_of_cobevglue_is_set_off(tmp_path: Path) -> None:
    text = written(tmp_path / "index.html", Section("Noise", "", [TABLE]))
    assert '<tr class="strong"><td>CoBEVGlue</td><td>0.912</td><td>–</td></tr>' in text
    assert text.count('class="strong"') == 1


def test_sections_are_listed_and_ordered(tmp_path: Path) -> None:
    picture = ap_over_noise(["0 m"], {"late": [0.5]}, "title")
    first = Section("First", "one", figures=[("A figure", picture)])
    text = written(tmp_path / "index.html", first, Section("Second", "two"))
    places = [text.index(part) for part in ("<nav>", "</nav>", "<p>one</p>", "A figure</figcaption>", "<p>two</p>")]
    assert places == sorted(places)
    assert text.count('src="data:image/png;base64,') == 1
    assert "http" not in text


def test_non_picture_is_refused_and_nothing_written(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="figure 'A figure': not a PNG"):
        write_report(tmp_path / "index.html", "A study", [Section("S", "", figures=[("A figure", b"")])])
    assert not list(tmp_path.iterdir())
