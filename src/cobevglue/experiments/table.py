"""A table of results, written as Markdown or CSV."""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["Cell", "Table"]

Cell = str | int | float | None
"""Text, a count, a measured number, or None for a missing value."""

_MISSING = "–"


@dataclass(frozen=True, slots=True)
class Table:
    """A table.

    Attributes:
        name: short and in lower case, for file names: "noise".
        title: the line above it.
        columns: names; the first column holds the row names.
        rows: cells, one per column.
        notes: sentences below it.

    Raises:
        ValueError: a row does not have one cell per column; names it.
    """

    name: str
    title: str
    columns: Sequence[str]
    rows: Sequence[Sequence[Cell]]
    notes: Sequence[str] = ()

    def __post_init__(self) -> None:
        """Check the length of each row."""
        for number, row in enumerate(self.rows):
            if len(row) != len(self.columns):
                raise ValueError(f"{self.name}: row {number} has {len(row)} cells, not {len(self.columns)}")

    def text_rows(self) -> list[list[str]]:
        """The cells as text: measured numbers with about three digits, a dash for missing values."""
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
        """Header and rows with unrounded numbers; missing values and NaN are empty cells."""
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
    if 1e-9 < abs(cell) < 0.01:  # such as a share of bytes; smaller values are rounding errors
        return f"{cell:.2g}"
    return f"{cell:,.0f}" if abs(cell) >= 100.0 else f"{cell:.1f}" if abs(cell) >= 10.0 else f"{cell:.3f}"
