"""Output of commands: results (tables or one JSON document) to standard output, progress to standard error."""

from __future__ import annotations

import json
import math
import re
import sys
from collections.abc import Sequence
from typing import Any

__all__ = ["print_json", "print_note", "print_table"]

_INNERMOST_LIST = re.compile(r"\[\s*\n([^\[\]{}\"]*?)\s*\]")
"""A list of numbers over several lines, which is joined to one line. JSON strings contain no line breaks."""


def print_json(document: dict[str, Any]) -> None:
    """Print a JSON document to standard output; non-finite numbers become null."""
    text = json.dumps(_finite(document), indent=2, ensure_ascii=False, allow_nan=False)
    print(_INNERMOST_LIST.sub(lambda found: "[" + " ".join(found[1].split()) + "]", text))


def print_note(text: str) -> None:
    """Print a line of progress or explanation to standard error."""
    print(text, file=sys.stderr, flush=True)


def print_table(title: str, header: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print a table to standard output: the first column left-aligned, the others right-aligned."""
    from rich import box
    from rich.console import Console
    from rich.table import Table

    table = Table(
        title=title or None,
        box=box.SIMPLE_HEAD,
        show_header=any(header),
        title_justify="left",
        title_style="bold",
        pad_edge=False,
    )
    for number, name in enumerate(header):
        table.add_column(name, justify="right" if number else "left", overflow="fold")
    for row in rows:
        table.add_row(*row)
    console = Console(highlight=False, markup=False, emoji=False)
    if not console.is_terminal:  # to a file or a pipe: without wrapping
        console.width = 200
    console.print(table)


def _finite(value: Any) -> Any:
    """`value` with None in place of non-finite numbers."""
    if isinstance(value, dict):
        return {key: _finite(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
