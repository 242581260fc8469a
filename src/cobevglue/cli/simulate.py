"""`cobevglue simulate`: a junction as a data set in OPV2V's format."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from cobevglue.cli.errors import expected_errors
from cobevglue.cli.output import print_json, print_note

__all__ = ["Format", "simulate"]


class Format(str, Enum):
    """On-disk formats that can be written."""

    OPV2V = "opv2v"


def simulate(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Root of the data set; made if it is not there.")],
    kind: Annotated[Format, typer.Option("--format", help="Layout of the files.")] = Format.OPV2V,
    split: Annotated[str, typer.Option(help="Name of the split.")] = "test",
    seed: Annotated[int, typer.Option(min=0, help="Of the scene.")] = 0,
    frames: Annotated[int, typer.Option(min=1, max=6000, help="How many frames, 10 a second.")] = 80,
    agents: Annotated[int, typer.Option(min=1, max=8, help="How many agents.")] = 2,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Write a simulated junction as a data set in OPV2V's format.

    The tree is OUT/SPLIT/junction_SEED/AGENT/NUMBER.yaml: poses, and the true boxes of what each agent saw. There are
    no point clouds yet. If it is interrupted, the same command goes on where it stopped.
    """
    from cobevglue.cli.junction_export import write_junction

    with expected_errors():
        written = write_junction(out, split, seed=seed, frames=frames, agents=agents, progress=print_note)
    if as_json:
        print_json(written)
    else:
        print(
            f"{written['scenario_folder']}: {written['files_written']} files written, "
            f"{written['files_kept']} were there already"
        )
