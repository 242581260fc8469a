"""Building blocks of report pages: self-contained HTML files that load nothing from other places.

Text given to any of these is plain text; what they return is HTML.
"""

from __future__ import annotations

import base64
from collections.abc import Container, Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path

from cobevglue.datasets.atomic_files import atomic_write

__all__ = ["Part", "figure", "paragraphs", "table", "write_page"]

_STYLE = """
:root { color-scheme: light dark; --text: #1b1f24; --page: #ffffff; --line: #dfe3e8; --faint: #57606a; --good: #00674b;
        --inset: #f4f6f8; --link: #00578a; }
@media (prefers-color-scheme: dark) {
  :root { --text: #e4e8ec; --page: #15181c; --line: #343a41; --faint: #9aa4ae; --good: #4fd1a5; --inset: #20252b;
          --link: #7cc0f0; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 2.5rem 1.5rem 4rem; max-width: 80rem; color: var(--text); background: var(--page);
       font: 17px/1.55 system-ui, -apple-system, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; }
a { color: var(--link); }
h1 { font-size: 2rem; line-height: 1.2; margin: 0 0 0.6rem; }
h2 { font-size: 1.3rem; margin: 2.8rem 0 0.5rem; scroll-margin-top: 1rem; }
h3 { font-size: 1rem; margin: 1.6rem 0 0.3rem; }
p { max-width: 46rem; margin: 0.5rem 0 1rem; }
pre { overflow-x: auto; padding: 0.7rem 1rem; background: var(--inset); border-radius: 6px; font-size: 0.85rem; }
.lead { font-size: 1.12rem; }
nav ol { columns: 20rem; max-width: 60rem; padding-left: 1.4rem; }
table { border-collapse: collapse; margin: 0.6rem 0; font-variant-numeric: tabular-nums; }
th, td { padding: 0.45rem 1.1rem 0.45rem 0; text-align: right; white-space: nowrap;
         border-bottom: 1px solid var(--line); }
th:first-child, td:first-child { text-align: left; }
td.text { white-space: normal; min-width: 14rem; max-width: 30rem; overflow-wrap: break-word; }
th { font-weight: 600; border-bottom: 2px solid var(--text); vertical-align: bottom; white-space: normal; }
tr.strong td { font-weight: 700; color: var(--good); }
.scroll { overflow-x: auto; }
.notes { margin: 0.2rem 0 1.2rem; padding-left: 1.2rem; max-width: 60rem; color: var(--faint); font-size: 0.88rem; }
figure { margin: 1rem 0 1.6rem; }
figure img { display: block; max-width: max(100%, 42rem); height: auto; border-radius: 6px; background: #ffffff; }
figcaption { max-width: 60rem; margin-top: 0.4rem; color: var(--faint); font-size: 0.92rem; }
footer { margin-top: 3rem; padding-top: 0.8rem; border-top: 1px solid var(--line); color: var(--faint);
         font-size: 0.9rem; }
@media (max-width: 48rem) {
  body { padding: 1.5rem 1rem 3rem; font-size: 16px; }
  table { font-size: 0.84rem; }
  th, td, td.text { padding: 0.4rem 0.7rem 0.4rem 0; white-space: normal; min-width: 0; }
  td.text { min-width: 9rem; }
  th:first-child, td:first-child { position: sticky; left: 0; min-width: 6.5rem; max-width: 9.5rem;
                                   background: var(--page); } }
"""


_LONG_CELL = 36
"""Cells of more characters are broken into lines."""


@dataclass(frozen=True, slots=True)
class Part:
    """A section of a page.

    Attributes:
        heading: of the part, plain text.
        html: what is under it, as the functions of this module return it.
    """

    heading: str
    html: str


def paragraphs(text: str) -> str:
    """Paragraphs of plain text; an empty line ends one. One whose lines all begin with four spaces is kept as it is."""
    parts = []
    for block in (b for b in text.replace("\r\n", "\n").split("\n\n") if b.strip()):
        lines = block.strip("\n").split("\n")
        if all(line.startswith("    ") for line in lines):
            parts.append(f"<pre>{escape(chr(10).join(line[4:] for line in lines))}</pre>")
        else:
            parts.append(f"<p>{escape(' '.join(line.strip() for line in lines))}</p>")
    return "\n".join(parts)


def table(
    header: Sequence[str], rows: Sequence[Sequence[str]], strong: Container[int] = (), notes: Sequence[str] = ()
) -> str:
    """A table of text, which scrolls by itself where it is wider than the page; the names of its rows stay in sight.

    Args:
        header: the names of the columns.
        rows: the cells, as many in a row as there are columns; the first one names the row.
        strong: numbers of the rows that are set off, from 0.
        notes: what to know about it, in small print below.

    Raises:
        ValueError: a row has another number of cells than there are columns.
    """
    lines = []
    for number, row in enumerate(rows):
        if len(row) != len(header):
            raise ValueError(f"row {number} has {len(row)} cells, the table has {len(header)} columns")
        start = '<tr class="strong">' if number in strong else "<tr>"
        lines.append(f"{start}{''.join(map(_cell, row))}</tr>")
    head = "".join(f"<th>{escape(cell)}</th>" for cell in header)
    body = f"<table><thead><tr>{head}</tr></thead><tbody>{''.join(lines)}</tbody></table>"
    below = "".join(f"<li>{escape(note)}</li>" for note in notes)
    return f'<div class="scroll">{body}</div>' + (f'<ul class="notes">{below}</ul>' if below else "")


def _cell(text: str) -> str:
    """A cell of a table's body; only long text is broken into lines, so that numbers and names stay in one."""
    start = '<td class="text">' if len(text) > _LONG_CELL else "<td>"
    return f"{start}{escape(text)}</td>"


def figure(png: bytes, caption: str = "", text: str = "") -> str:
    """A picture with its caption, which scrolls by itself where the page is too narrow for its text to be read.

    Args:
        png: the picture as the bytes of a PNG file.
        caption: below the picture.
        text: what the picture shows, for those who cannot see it; the caption where left out.

    Raises:
        ValueError: these are not the bytes of a PNG file.
    """
    if not png.startswith(b"\x89PNG\r\n"):
        raise ValueError(f"figure {caption!r}: not a PNG file, it starts with {png[:8]!r}")
    data = base64.b64encode(png).decode("ascii")
    image = f'<div class="scroll"><img src="data:image/png;base64,{data}" alt="{escape(text or caption)}"></div>'
    return f"<figure>{image}{f'<figcaption>{escape(caption)}</figcaption>' if caption else ''}</figure>"


def write_page(
    path: str | Path, title: str, lead: str, parts: Sequence[Part], footer: str = "", contents: bool = False
) -> Path:
    """Write a page that opens in any browser, from disk, without a network. It is there complete or not at all.

    Args:
        path: the file; its folder is made if it is not there.
        title: of the page.
        lead: the paragraph under the title: what one sees here; "" for none.
        parts: the page, in order.
        footer: small print.
        contents: begin with a table of contents.

    Returns:
        The file.

    Raises:
        OSError: the page cannot be written.
    """
    body = [f"<h1>{escape(title)}</h1>"]
    if lead:
        body.append(f'<p class="lead">{escape(lead)}</p>')
    if contents:
        entries = (f'<li><a href="#part-{i}">{escape(part.heading)}</a></li>' for i, part in enumerate(parts, start=1))
        body.append(f"<nav><ol>{''.join(entries)}</ol></nav>")
    for number, part in enumerate(parts, start=1):
        body += [f'<h2 id="part-{number}">{escape(part.heading)}</h2>', part.html]
    if footer:
        body.append(f"<footer>{escape(footer)}</footer>")
    page = (
        '<!doctype html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(title)}</title>\n<style>{_STYLE}</style>\n</head>\n<body>\n"
        + "\n".join(body)
        + "\n</body>\n</html>\n"
    )
    target = Path(path)
    with atomic_write(target) as partial:
        partial.write_text(page, encoding="utf-8")
    return target
