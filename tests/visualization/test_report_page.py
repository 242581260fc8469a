"""Building blocks of pages: one file that opens without a network, in which text is text."""

from __future__ import annotations

import base64
from pathlib import Path

import pytest

from cobevglue.visualization.report_page import Part, figure, paragraphs, table, write_page

PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)
NASTY = '<script>alert("1")</script> & more'


def test_pictures_are_inside_the_page(tmp_path: Path) -> None:
    page = write_page(tmp_path / "new" / "page.html", "Title", "Lead", [Part("One", figure(PIXEL, "A pixel"))])
    text = page.read_text(encoding="utf-8")
    assert f'src="data:image/png;base64,{base64.b64encode(PIXEL).decode()}"' in text
    assert text.startswith("<!doctype html>")
    assert "http" not in text
    assert [path.name for path in page.parent.iterdir()] == ["page.html"], "nothing is left beside it"


def test_text_is_text_and_not_markup(tmp_path: Path) -> None:
    html = paragraphs(NASTY) + table([NASTY], [[NASTY]], notes=[NASTY]) + figure(PIXEL, NASTY, NASTY)
    text = write_page(tmp_path / "page.html", NASTY, NASTY, [Part(NASTY, html)], NASTY, contents=True).read_text()
    assert "<script>" not in text
    assert text.count("&lt;script&gt;") == 12


@pytest.mark.parametrize(
    ("text", "html"),
    [
        ("", ""),
        ("one", "<p>one</p>"),
        ("one\ntwo", "<p>one two</p>"),
        ("one\n\n\n\ntwo\n", "<p>one</p>\n<p>two</p>"),
        ("Run:\n\n    cobevglue demo\n      --json", "<p>Run:</p>\n<pre>cobevglue demo\n  --json</pre>"),
        ("    kept\nnot kept", "<p>kept not kept</p>"),
    ],
)
def test_empty_line_ends_paragraph_and_indents_stay(text: str, html: str) -> None:
    assert paragraphs(text) == html


def test_a_row_can_be_set_off() -> None:
    html = table(["name", "value"], [["a", "1"], ["b", "2"]], strong=[1])
    assert '<tr class="strong"><td>b</td><td>2</td></tr>' in html
    assert "<tr><td>a</td><td>1</td></tr>" in html


def test_only_long_cells_are_broken_into_lines(tmp_path: Path) -> None:
    html = table(["name", "value"], [["a", "0.841"], ["b", "word " * 20]])
    assert "<td>0.841</td>" in html
    assert f'<td class="text">{"word " * 20}</td>' in html
    assert (
        "td.text { white-space: normal;" in write_page(tmp_path / "page.html", "T", "", [Part("P", html)]).read_text()
    )


def test_tables_and_pictures_scroll_by_themselves() -> None:
    assert table(["name"], [["a"]]).startswith('<div class="scroll"><table>')
    assert figure(PIXEL).startswith('<figure><div class="scroll"><img')


def test_a_row_of_another_length_is_refused() -> None:
    with pytest.raises(ValueError, match="row 1 has 1 cells, the table has 2 columns"):
        table(["a", "b"], [["1", "2"], ["3"]])


def test_other_kinds_of_files_are_no_pictures() -> None:
    with pytest.raises(ValueError, match=r"figure 'movie': not a PNG file, it starts with b'GIF89a"):
        figure(b"GIF89a....", "movie")


def test_the_table_of_contents_leads_to_the_parts(tmp_path: Path) -> None:
    parts = [Part("First", ""), Part("Second", "")]
    text = write_page(tmp_path / "page.html", "T", "", parts, contents=True).read_text()
    for number, part in enumerate(parts, start=1):
        assert f'<a href="#part-{number}">{part.heading}</a>' in text
        assert f'<h2 id="part-{number}">{part.heading}</h2>' in text
    assert "<nav>" not in write_page(tmp_path / "page.html", "T", "", parts).read_text()
