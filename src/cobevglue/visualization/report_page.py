"""A report as one HTML file: text, tables and pictures inside, nothing loaded from anywhere."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

__all__ = ["Section", "Table", "write_page"]

_IMAGE_TYPES = {".png": "image/png", ".gif": "image/gif", ".svg": "image/svg+xml"}

_STYLE = """
body { margin: 0 auto; padding: 2.5rem 1.5rem 4rem; max-width: 70rem; color: #1b1f24; background: #ffffff;
       font: 17px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
h1 { font-size: 2rem; line-height: 1.2; margin: 0 0 0.6rem; }
h2 { font-size: 1.3rem; margin: 2.8rem 0 0.5rem; }
p { max-width: 44rem; margin: 0.5rem 0 1rem; }
.lead { font-size: 1.12rem; }
table { border-collapse: collapse; margin: 1rem 0; font-variant-numeric: tabular-nums; }
th, td { padding: 0.45rem 1.1rem 0.45rem 0; text-align: right; border-bottom: 1px solid #dfe3e8; }
th:first-child, td:first-child { text-align: left; }
th { font-weight: 600; border-bottom: 2px solid #1b1f24; vertical-align: bottom; }
tr.strong td { font-weight: 700; color: #00674b; }
img { display: block; max-width: 100%; height: auto; margin: 0.8rem 0; }
.scroll { overflow-x: auto; }
footer { margin-top: 3rem; padding-top: 0.8rem; border-top: 1px solid #dfe3e8; color: #57606a; font-size: 0.9rem; }
"""


@dataclass(frozen=True, slots=True)
class Table:
    """A table of text.

    Attributes:
        header: the names of the columns.
        rows: the cells, as many in a row as there are columns; the first one names the row.
        strong: the row that is set off, counted from 0, or None.
    """

    header: Sequence[str]
    rows: Sequence[Sequence[str]]
    strong: int | None = None


@dataclass(frozen=True, slots=True)
class Section:
    """A part of the page: heading, paragraphs, then a table and a picture if there are any.

    Attributes:
        heading: of the section.
        paragraphs: plain text.
        table: a table, or None.
        picture: a `.png`, `.gif` or `.svg` file that is put into the page, or None.
        picture_text: what the picture shows, for those who cannot see it.
    """

    heading: str
    paragraphs: Sequence[str]
    table: Table | None = None
    picture: Path | None = None
    picture_text: str = ""


def write_page(path: str | Path, title: str, lead: str, sections: Sequence[Section], footer: str = "") -> Path:
    """Write the report. It opens in any browser, from disk, without a network.

    Args:
        path: the file; its folder is made if it is not there.
        title: of the page.
        lead: the paragraph under the title: what one sees here.
        sections: the parts, in order.
        footer: small print.

    Returns:
        The file.

    Raises:
        ValueError: a picture is of another kind.
        OSError: a picture cannot be read or the page cannot be written.
    """
    parts = [f"<h1>{escape(title)}</h1>", f'<p class="lead">{escape(lead)}</p>']
    for section in sections:
        parts.append(f"<h2>{escape(section.heading)}</h2>")
        parts += [f"<p>{escape(paragraph)}</p>" for paragraph in section.paragraphs]
        if section.table is not None:
            parts.append(_table(section.table))
        if section.picture is not None:
            parts.append(f'<img src="{_data_url(section.picture)}" alt="{escape(section.picture_text)}">')
    if footer:
        parts.append(f"<footer>{escape(footer)}</footer>")
    page = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        + "\n".join(parts)
        + "\n</body>\n</html>\n"
    )
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_text(page, encoding="utf-8")
    return target


def _table(table: Table) -> str:
    head = "".join(f"<th>{escape(cell)}</th>" for cell in table.header)
    rows = []
    for number, row in enumerate(table.rows):
        cells = "".join(f"<td>{escape(cell)}</td>" for cell in row)
        start = '<tr class="strong">' if number == table.strong else "<tr>"
        rows.append(f"{start}{cells}</tr>")
    return f'<div class="scroll"><table><thead><tr>{head}</tr></thead><tbody>{"".join(rows)}</tbody></table></div>'


def _data_url(picture: Path) -> str:
    kind = _IMAGE_TYPES.get(picture.suffix.lower())
    if kind is None:
        raise ValueError(f"{picture}: a page shows {', '.join(_IMAGE_TYPES)} pictures only")
    return f"data:{kind};base64,{base64.b64encode(picture.read_bytes()).decode('ascii')}"
