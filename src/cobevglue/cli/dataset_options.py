"""Option `--dataset-option` of the commands that read a data set."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

import typer

from cobevglue.cli.errors import InputError

__all__ = ["DatasetOptions", "parse_dataset_options"]

DatasetOptions = Annotated[
    list[str] | None,
    typer.Option(
        "--dataset-option",
        metavar="KEY=VALUE",
        help="Argument of the data set's reader, such as labels=original (DAIR-V2X) or left_handed=true (V2V4Real).",
    ),
]


def parse_dataset_options(texts: Sequence[str] | None) -> dict[str, Any]:
    """Parse KEY=VALUE texts to a dictionary; values are parsed as YAML.

    Raises:
        InputError: a text is not KEY=VALUE, or its value is not YAML.
    """
    import yaml  # imported here to keep `--help` fast

    options = {}
    for text in texts or ():
        key, equals, value = text.partition("=")
        if not key or not equals:
            raise InputError(f"--dataset-option {text}: must be KEY=VALUE")
        try:
            options[key] = yaml.safe_load(value)
        except yaml.YAMLError:
            raise InputError(f"--dataset-option {text}: the value is not readable as YAML") from None
    return options
