"""`cobevglue train`: training of the detector, its heading refinement, or a fusion method."""

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
    """Stages of training."""

    DETECTOR = "detector"
    HEADING = "heading"
    FUSION = "fusion"


def train(
    stage: Annotated[Stage, typer.Argument(help="Stage of training.")],
    config: Annotated[
        str, typer.Option(help="Name of a preset (for fusion: the method), or a YAML file that overrides one.")
    ],
    out: Annotated[Path | None, typer.Option(help="Folder of the run; default: runs/STAGE-CONFIG.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Resume the run in that folder.")] = False,
    changes: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Change a setting: optimisation.epochs=3. May be repeated."),
    ] = None,
    max_minutes: Annotated[
        float | None, typer.Option(min=0.0, help="Time limit; stop before an epoch that would exceed it.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Train a network; weights, state, log and TensorBoard events are written to one folder.

    --resume continues an interrupted run after its last complete epoch, with the same result as without interruption.
    For several processes, use torchrun: torchrun --nproc-per-node 2 -m cobevglue train detector --config compact
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
                raise ValueError("--max-minutes: is for the detector only; the other stages take minutes")
            elif stage is Stage.HEADING:
                result = train_heading(load_heading_config(config, changes or ()), folder, resume=resume)
            else:
                result = train_fusion(load_fusion_config(config, changes or ()), folder, resume=resume)
    except DivergedError as error:
        raise InputError(str(error)) from error
    except KeyboardInterrupt:
        if (folder / "state.pt").is_file():
            print_note(
                f"the last complete epoch is saved in {folder}; the same command with --resume continues from there"
            )
        raise
    if as_json:
        print_json({**dataclasses.asdict(result), "folder": str(folder)})
