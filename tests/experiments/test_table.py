"""Tables: what people read, and what programs read."""

from __future__ import annotations

import csv
import io
import math

import pytest

from cobevglue.experiments.table import Cell, Table

TABLE = Table(
    "noise",
    "Average precision",
    ("method", "AP@0.5", "bytes"),
    [("CoBEVGlue", 0.95812345, 2_813_211), ("a | b\nc", math.nan, None)],
    ("Range: everywhere.",),
)


def test_markdown_has_title_rows_and_notes() -> None:
    assert TABLE.to_markdown().splitlines() == [
        "### Average precision",
        "",
        "| method | AP@0.5 | bytes |",
        "| --- | ---: | ---: |",
        "| CoBEVGlue | 0.958 | 2,813,211 |",
        "| a \\| b c | – | – |",
        "",
        "Range: everywhere.",
    ]


def test_csv_has_all_digits_and_empty_cells() -> None:
    rows = list(csv.reader(io.StringIO(TABLE.to_csv())))
    assert rows == [["method", "AP@0.5", "bytes"], ["CoBEVGlue", "0.95812345", "2813211"], ["a | b\nc", "", ""]]


@pytest.mark.parametrize(
    ("cell", "text"),
    [
        ("as it is", "as it is"),
        (3, "3"),
        (1234567, "1,234,567"),
        (0.0, "0.000"),
        (0.00036, "0.00036"),  # a share that three decimals would hide
        (-0.004, "-0.004"),
        (0.5, "0.500"),
        (0.0123, "0.012"),
        (5e-15, "0.000"),
        (9.8765, "9.877"),
        (12.3456, "12.3"),
        (123.456, "123"),
        (4321.9, "4,322"),
        (math.inf, "inf"),
        (math.nan, "–"),
        (None, "–"),
    ],
)
def test_numbers_are_short_and_never_rounded_to_nothing(cell: Cell, text: str) -> None:
    assert Table("t", "T", ("a",), [(cell,)]).text_rows() == [[text]]


def test_a_row_that_is_too_short_is_refused() -> None:
    with pytest.raises(ValueError, match="t: row 1 has 1 cells, not 2"):
        Table("t", "T", ("a", "b"), [(1, 2), (1,)])
