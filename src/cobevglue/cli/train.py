"""`cobevglue train`: a stage of training."""

from __future__ import annotations

import dataclasses
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from cobevglue.cli.errors import InputError, expected_errors
from cobevglue.cli.output import print_json, print_note

__all__ = ["Stage", "train"]


class Stage(str, Enum):
    """What can be trained."""

    DETECTOR = "detector"
    HEADING = "heading"
    FUSION = "fusion"


def train(
    stage: Annotated[Stage, typer.Argument(help="What to train.")],
    config: Annotated[
        str, typer.Option(help="Name of shipped settings (of fusion: the method), or a YAML file that overrides them.")
    ],
    out: Annotated[Path | None, typer.Option(help="Folder of the run; runs/STAGE-CONFIG if left out.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on with the run in that folder.")] = False,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a setting: optimisation.epochs=3. May be repeated."),
    ] = None,
    max_minutes: Annotated[
        float | None, typer.Option(min=0.0, help="Stop after the last epoch that is done in this time.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Train a network; weights, state, log and TensorBoard events go to one folder.

    An interrupted run goes on after its last full epoch with --resume, as if it had never stopped. For many processes,
    start it with torchrun: torchrun --nproc-per-node 2 -m cobevglue train detector --config compact
    """
    try:
        from cobevglue.training import (
            DivergedError,
            load_config,
            load_fusion_config,
            load_heading_config,
            train_detector,
            train_fusion,
            train_heading,
        )
    except ImportError as error:
        raise InputError(" ".join(str(error).split())) from error
    folder = out if out is not None else Path("runs") / f"{stage.value}-{Path(config).stem}"
    try:
        with expected_errors():
            if stage is Stage.DETECTOR:
                settings = load_config(config, changes or ())
                result = train_detector(settings, folder, resume=resume, max_minutes=max_minutes)
            elif max_minutes is not None:
                raise ValueError("--max-minutes: is for the detector; all else takes minutes")
            elif stage is Stage.HEADING:
                result = train_heading(load_heading_config(config, changes or ()), folder, resume=resume)
            else:
                result = train_fusion(load_fusion_config(config, changes or ()), folder, resume=resume)
    except DivergedError as error:
        raise InputError(str(error)) from error
    except KeyboardInterrupt:
        if (folder / "state.pt").is_file():
            print_note(
                f"the run in {folder} keeps its last full epoch; the same command with --resume goes on from there"
            )
        raise
    if as_json:
        print_json({**dataclasses.asdict(result), "folder": str(folder)})
