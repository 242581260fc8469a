"""`cobevglue evaluate`: a method on a data set."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from cobevglue.cli.dataset_options import DatasetOptions, parse_dataset_options
from cobevglue.cli.errors import InputError
from cobevglue.cli.evaluate_align import evaluate_align
from cobevglue.cli.evaluate_detect import DetectTask, evaluate_detect

__all__ = ["Dataset", "Task", "evaluate"]


class Task(str, Enum):
    """What can be evaluated."""

    ALIGN = "align"
    DETECT = "detect"


class Dataset(str, Enum):
    """Data sets by name; `simulated` is made on the way."""

    OPV2V = "opv2v"
    V2XSET = "v2xset"
    V2V4REAL = "v2v4real"
    DAIR_V2X = "dair-v2x"
    SIMULATED = "simulated"


_ONLY_FOR = {
    Task.ALIGN: ("max_range", "perfect", "paper"),
    Task.DETECT: ("weights", "reach", "min_points", "scenario", "frames", "picture", "failures", "dataset_option"),
}
"""Options that one task knows and the other does not."""


def evaluate(
    context: typer.Context,
    root: Annotated[Path | None, typer.Option(help="Root of the data set; none for simulated.")] = None,
    task: Annotated[Task, typer.Option(help="What to evaluate.")] = Task.ALIGN,
    dataset: Annotated[Dataset, typer.Option(help="Format of the data set.")] = Dataset.OPV2V,
    split: Annotated[str, typer.Option(help="Name of the split.")] = "test",
    dataset_option: DatasetOptions = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the detection errors, or of simulated worlds.")] = 0,
    max_range: Annotated[
        float, typer.Option(min=1.0, help="align: objects farther away are not detected, in metres.")
    ] = 70.0,
    perfect: Annotated[
        bool, typer.Option("--perfect", help="align: labels as they are, without a detector's errors.")
    ] = False,
    paper: Annotated[
        bool, typer.Option("--paper", help="align: the paper's own settings instead of the default.")
    ] = False,
    weights: Annotated[str, typer.Option(help="detect: a shipped model's name, or a .safetensors file.")] = "compact",
    reach: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--range", help="detect: objects count up to this |x| and |y|, in metres; else as far as the model looks."
        ),
    ] = None,
    min_points: Annotated[int, typer.Option(min=0, help="detect: objects with fewer points are ignored.")] = 0,
    scenario: Annotated[str | None, typer.Option(help="detect: go through this scenario only.")] = None,
    frames: Annotated[
        int | None, typer.Option(min=1, help="detect: look at this many clouds at most; 100 of simulated ones.")
    ] = None,
    picture: Annotated[Path | None, typer.Option(help="detect: folder for a picture of every tenth cloud.")] = None,
    failures: Annotated[
        Path | None, typer.Option(help="detect: CSV file for every missed object and false detection.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Measure the alignment (`--task align`) or the detector (`--task detect`) on a data set.

    align: BEVGlue on every pair of agents, by the number of objects both detected. The labels get a detector's errors
    (missed, displaced, flipped and false boxes) and are tracked. Poses of the data set are the truth and never reach
    the alignment. Wrong is what is accepted and off by more than 3 m or 3 degrees.

    detect: PointPillars on every agent's own cloud against that agent's own labels: average precision by distance, in
    both of its dialects, and what is wrong with the boxes found.
    """
    _refuse_options_of_others(context, task)
    options = parse_dataset_options(dataset_option)
    if task is Task.DETECT:
        wanted = DetectTask(
            root,
            dataset.value,
            split,
            weights,
            reach,
            min_points,
            scenario,
            frames,
            seed,
            picture,
            failures,
            options,
        )
        evaluate_detect(wanted, as_json)
        return
    if root is None:
        raise InputError("--task align needs --root, the folder of the data set")
    evaluate_align(
        root,
        dataset.value,
        split,
        max_range=max_range,
        perfect=perfect,
        paper=paper,
        seed=seed,
        as_json=as_json,
    )


def _refuse_options_of_others(context: typer.Context, task: Task) -> None:
    """An option that would have no effect is an error."""
    for other, names in _ONLY_FOR.items():
        for name in names if other is not task else ():
            source = context.get_parameter_source(name)
            if source is not None and source.name == "COMMANDLINE":
                option = "--" + ("range" if name == "reach" else name.replace("_", "-"))
                raise InputError(f"{option} is for --task {other.value}, and has no effect on --task {task.value}")
