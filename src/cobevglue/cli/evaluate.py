"""`cobevglue evaluate`: evaluation of alignment or detection on a data set."""

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
    """Evaluation tasks."""

    ALIGN = "align"
    DETECT = "detect"


class Dataset(str, Enum):
    """Data sets by name; `simulated` is generated during the evaluation."""

    OPV2V = "opv2v"
    V2XSET = "v2xset"
    V2V4REAL = "v2v4real"
    DAIR_V2X = "dair-v2x"
    SIMULATED = "simulated"


_ONLY_FOR = {
    Task.ALIGN: ("max_range", "perfect", "paper"),
    Task.DETECT: ("weights", "reach", "min_points", "scenario", "frames", "picture", "failures", "dataset_option"),
}
"""Options that only one task has."""


def evaluate(
    context: typer.Context,
    root: Annotated[Path | None, typer.Option(help="Root of the data set; not for simulated.")] = None,
    task: Annotated[Task, typer.Option(help="What to evaluate.")] = Task.ALIGN,
    dataset: Annotated[Dataset, typer.Option(help="Format of the data set.")] = Dataset.OPV2V,
    split: Annotated[str, typer.Option(help="Name of the split.")] = "test",
    dataset_option: DatasetOptions = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the detection errors, or of simulated worlds.")] = 0,
    max_range: Annotated[
        float, typer.Option(min=1.0, help="align: objects farther away are not detected, in metres.")
    ] = 70.0,
    perfect: Annotated[
        bool, typer.Option("--perfect", help="align: use labels without simulated detection errors.")
    ] = False,
    paper: Annotated[
        bool, typer.Option("--paper", help="align: use the paper's settings instead of the default.")
    ] = False,
    weights: Annotated[str, typer.Option(help="detect: name of shipped weights, or a .safetensors file.")] = "compact",
    reach: Annotated[
        tuple[float, float] | None,
        typer.Option(
            "--range", help="detect: evaluate objects up to this |x| and |y|, in metres; default: the detector's range."
        ),
    ] = None,
    min_points: Annotated[int, typer.Option(min=0, help="detect: objects with fewer points are ignored.")] = 0,
    scenario: Annotated[str | None, typer.Option(help="detect: evaluate this scenario only.")] = None,
    frames: Annotated[
        int | None, typer.Option(min=1, help="detect: maximum number of clouds; default: all, or 100 simulated ones.")
    ] = None,
    picture: Annotated[Path | None, typer.Option(help="detect: folder for a picture of every tenth cloud.")] = None,
    failures: Annotated[
        Path | None, typer.Option(help="detect: CSV file of missed objects and false detections.")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Evaluate alignment (`--task align`) or detection (`--task detect`) on a data set.

    align: BEVGlue on every pair of agents, by number of co-visible objects. Detection errors (missed, displaced,
    flipped and false boxes) are added to the labels, which are then tracked. Poses of the data set are ground truth and
    are not passed to the aligner. Wrong alignments are those accepted with an error above 3 m or 3 degrees.

    detect: PointPillars on every agent's own cloud and labels: average precision by distance, in both of its
    definitions, and errors of the detected boxes.
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
    """Raise an error for options of the other task."""
    for other, names in _ONLY_FOR.items():
        for name in names if other is not task else ():
            source = context.get_parameter_source(name)
            if source is not None and source.name == "COMMANDLINE":
                option = "--" + ("range" if name == "reach" else name.replace("_", "-"))
                raise InputError(f"{option} is for --task {other.value}, and has no effect on --task {task.value}")
