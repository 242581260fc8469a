"""A table of results, as Markdown for people and as CSV for programs."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["Cell", "Table"]

Cell = str | int | float | None
"""Text, a count, a measured number, or None for what was not measured."""

_MISSING = "–"


@dataclass(frozen=True, slots=True)
class Table:
    """A table.

    Attributes:
        name: short and in lower case, for files: "noise".
        title: the line above it.
        columns: their names; the first column names the rows.
        rows: the cells, as many in a row as there are columns.
        notes: sentences below it.

    Raises:
        ValueError: a row has not as many cells as there are columns; says which.
    """

    name: str
    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    notes: Sequence[str] = ()

    def __post_init__(self) -> None:
        """Refuse what is not rectangular."""
        for number, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                raise ValueError(f"{self.name}: row {number} has {len(row)} cells, not {len(self.columns)}")

    def text_rows(self) -> list[list[str]]:
        """The cells as people read them: measured numbers in about three digits, a dash for what is missing."""
        return [[_text(cell) for cell in row] for row in self.rows]

    def to_markdown(self) -> str:
        """Title, table and notes."""
        lines = [f"### {self.title}", ""]
        lines += [_markdown_row(self.columns), _markdown_row(["---"] + ["---:"] * (len(self.columns) - 1))]
        lines += [_markdown_row(row) for row in self.text_rows()]
        for note in self.notes:
            lines += ["", note]
        return "\n".join(lines) + "\n"

    def to_csv(self) -> str:
        """Header and rows with numbers in full; what is missing or NaN is an empty cell."""
        file = io.StringIO()
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(self.columns)
        writer.writerows([["" if _is_missing(cell) else cell for cell in row] for row in self.rows])
        return file.getvalue()


def _markdown_row(cells: Sequence[str]) -> str:
    return "| " + " | ".join(" ".join(cell.split()).replace("|", "\\|") for cell in cells) + " |"


def _is_missing(cell: Cell) -> bool:
    return cell is None or (isinstance(cell, float) and math.isnan(cell))


def _text(cell: Cell) -> str:
    if isinstance(cell, str):
        return cell
    if cell is None or _is_missing(cell):
        return _MISSING
    if isinstance(cell, int):
        return f"{cell:,}"
    if 1e-9 < abs(cell) < 0.01:  # such as a share of bytes; what is even less is rounding
        return f"{cell:.2g}"
    return f"{cell:,.0f}" if abs(cell) >= 100.0 else f"{cell:.1f}" if abs(cell) >= 10.0 else f"{cell:.3f}"
