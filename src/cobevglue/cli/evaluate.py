"""`cobevglue evaluate`: a method on a data set."""

from __future__ import annotations

import dataclasses
from enum import Enum
from pathlib import Path
from typing import Annotated

import typer

from cobevglue.cli.errors import expected_errors
from cobevglue.cli.output import print_json, print_note, print_table

__all__ = ["Dataset", "Task", "evaluate"]


class Task(str, Enum):
    """What can be evaluated."""

    ALIGN = "align"


class Dataset(str, Enum):
    """Data sets with exact poses and object ids, whose labels stand in for detections."""

    OPV2V = "opv2v"
    V2XSET = "v2xset"


def evaluate(
    root: Annotated[Path, typer.Option(help="Root of the data set.")],
    task: Annotated[Task, typer.Option(help="What to evaluate.")] = Task.ALIGN,
    dataset: Annotated[Dataset, typer.Option(help="Format of the data set.")] = Dataset.OPV2V,
    split: Annotated[str, typer.Option(help="Name of the split.")] = "test",
    max_range: Annotated[float, typer.Option(min=1.0, help="Objects farther away are not detected [m].")] = 70.0,
    perfect: Annotated[
        bool, typer.Option("--perfect", help="Labels as they are, without a detector's errors.")
    ] = False,
    paper: Annotated[bool, typer.Option("--paper", help="The paper's own settings instead of the default.")] = False,
    seed: Annotated[int, typer.Option(min=0, help="Of the detection errors.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Measure BEVGlue on every pair of agents of a data set, by the number of objects both detected.

    The labels get a detector's errors (missed, displaced, flipped and false boxes) and are tracked. Poses of the data
    set are the truth and never reach the alignment. Wrong is what is accepted and off by more than 3 m or 3 degrees.
    """
    from cobevglue import BEVGlue, BEVGlueConfig
    from cobevglue.datasets import OPV2V, V2XSet
    from cobevglue.disturbance.detection_errors import DetectionErrors
    from cobevglue.evaluation.alignment import by_co_visible, off_by_3
    from cobevglue.evaluation.alignment import evaluate as run
    from cobevglue.evaluation.alignment_data import noisy_label_sequences

    reader = OPV2V if dataset is Dataset.OPV2V else V2XSet
    errors = DetectionErrors.none() if perfect else DetectionErrors()
    config = BEVGlueConfig.paper() if paper else BEVGlueConfig()
    records = []
    with expected_errors():
        for sequence in noisy_label_sequences(reader(root, split), errors, seed, max_range):
            records += list(run([sequence], lambda: BEVGlue(config)))
            print_note(f"{sequence.name}: {len(sequence.frames)} frames")
    groups = by_co_visible(records, off_by_3)
    if as_json:
        print_json({name: dataclasses.asdict(group) for name, group in groups.items()})
        return
    print_table(
        f"BEVGlue on {dataset.value} {split}, objects within {max_range:.0f} m",
        ("co-visible", "frames", "@1", "@2", "@3", "refused", "wrong of accepted", "precision", "recall", "ms"),
        [
            (
                name,
                str(g.frames),
                *(f"{100 * share:.1f} %" for share in (g.success_1, g.success_2, g.success_3, g.refused)),
                f"{100 * g.wrong_of_accepted:.2f} %",
                f"{100 * g.match_precision:.1f} %",
                f"{100 * g.match_recall:.1f} %",
                f"{g.median_milliseconds:.2f}",
            )
            for name, g in groups.items()
        ],
    )
