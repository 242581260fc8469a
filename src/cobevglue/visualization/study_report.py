"""A study's tables and figures as one page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import Protocol

from cobevglue.visualization.report_page import Part, figure, paragraphs, table, write_page
from cobevglue.visualization.style import is_cobevglue

__all__ = ["Section", "Table", "write_report"]


class Table(Protocol):
    """What is shown of a table; `cobevglue.experiments` has the class."""

    @property
    def title(self) -> str:
        """What it shows."""

    @property
    def columns(self) -> Sequence[str]:
        """Names of the C columns."""

    @property
    def notes(self) -> Sequence[str]:
        """What to know about it."""

    def text_rows(self) -> Sequence[Sequence[str]]:
        """Rows of C cells as people read them; the first one names the row."""


@dataclass(frozen=True)
class Section:
    """A part of a study.

    Attributes:
        title: its heading.
        text: plain text; an empty line ends a paragraph, and one whose lines begin with four spaces is kept as it is.
        tables: below the text.
        figures: below the tables: captions and PNG files.
    """

    title: str
    text: str
    tables: Sequence[Table] = ()
    figures: Sequence[tuple[str, bytes]] = ()


def write_report(path: Path, title: str, sections: Sequence[Section]) -> None:
    """Write a study as one HTML file with its figures inside, which opens without a server or a network.

    Args:
        path: the file; its folder is made if it is not there.
        title: of the page.
        sections: in order; the page begins with a list of them.

    Raises:
        ValueError: a row of a table has too few or too many cells, or a figure is no PNG; names it.
        OSError: the page cannot be written.
    """
    write_page(path, title, "", [Part(section.title, _html(section)) for section in sections], contents=True)


def _html(section: Section) -> str:
    parts = [paragraphs(section.text)]
    for shown in section.tables:
        rows = shown.text_rows()
        ours = [number for number, row in enumerate(rows) if row and is_cobevglue(row[0])]
        try:
            parts += [f"<h3>{escape(shown.title)}</h3>", table(shown.columns, rows, ours, shown.notes)]
        except ValueError as error:
            raise ValueError(f"table {shown.title!r}: {error}") from None
    parts += [figure(png, caption) for caption, png in section.figures]
    return "\n".join(parts)
