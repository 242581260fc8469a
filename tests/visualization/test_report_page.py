"""The report page: one file that opens without a network."""

from __future__ import annotations

import base64
from pathlib import Path

import pytest

from cobevglue.visualization import Section, Table, write_page

PIXEL = base64.b64decode(
    "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAYAAAAfFcSJAAAADUlEQVR42mNk+M9QDwADhgGAWjR9awAAAABJRU5ErkJggg=="
)


def test_pictures_are_inside_the_page(tmp_path: Path) -> None:
    picture = tmp_path / "pixel.png"
    picture.write_bytes(PIXEL)
    page = write_page(tmp_path / "new" / "page.html", "Title", "Lead", [Section("One", ["Text"], picture=picture)])
    text = page.read_text(encoding="utf-8")
    assert f'src="data:image/png;base64,{base64.b64encode(PIXEL).decode()}"' in text
    assert text.startswith("<!doctype html>")
    assert "http" not in text


def test_text_is_text_and_not_markup(tmp_path: Path) -> None:
    nasty = '<script>alert("1")</script> & more'
    section = Section(nasty, [nasty], Table([nasty], [[nasty]]))
    text = write_page(tmp_path / "page.html", nasty, nasty, [section], footer=nasty).read_text(encoding="utf-8")
    assert "<script>" not in text
    assert text.count("&lt;script&gt;") == 8


def test_a_row_can_be_set_off(tmp_path: Path) -> None:
    table = Table(["name", "value"], [["a", "1"], ["b", "2"]], strong=1)
    text = write_page(tmp_path / "page.html", "T", "L", [Section("S", [], table)]).read_text(encoding="utf-8")
    assert '<tr class="strong"><td>b</td><td>2</td></tr>' in text
    assert "<tr><td>a</td><td>1</td></tr>" in text


def test_other_kinds_of_files_are_no_pictures(tmp_path: Path) -> None:
    movie = tmp_path / "movie.mp4"
    movie.write_bytes(b"")
    with pytest.raises(ValueError, match=r"movie\.mp4.*\.png"):
        write_page(tmp_path / "page.html", "T", "L", [Section("S", [], picture=movie)])
