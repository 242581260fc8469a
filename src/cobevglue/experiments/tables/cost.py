"""Communication volume and run time."""

from __future__ import annotations

import math

from cobevglue.experiments import paper
from cobevglue.experiments.condition import Condition
from cobevglue.experiments.measure import Results
from cobevglue.experiments.table import Cell, Table
from cobevglue.experiments.tables.scope import Experiment, Scope, aligner_title, as_is, method_title
from cobevglue.fusion import FUSION_METHODS

__all__ = ["COMMUNICATION", "TIME"]


def _collaborating(scope: Scope) -> list[str]:
    return [name for name in scope.methods if name != "none"]


def _conditions(scope: Scope) -> list[Condition]:
    return [as_is(name) for name in _collaborating(scope)]


def _communication(scope: Scope, results: Results, dataset: str) -> list[Table]:
    rows: list[list[Cell]] = []
    for name in _collaborating(scope):
        condition = as_is(name)
        payload, added = results.payload_bytes(condition), results.alignment_bytes(condition)
        kind = FUSION_METHODS[name].kind
        rows.append(
            [
                method_title(name),
                kind,
                payload,
                math.log2(payload) if payload > 0.0 else None,
                aligner_title(FUSION_METHODS[name].usual_aligner),
                added,
                100.0 * added / payload if payload > 0.0 else None,
            ]
        )
    columns = ("method", "sends", "bytes", "log2", "poses from", "bytes for alignment", "share [%]")
    notes = (
        "Of one collaborator in one frame, mean; the bytes that are encoded. Features in 16 bits, not compressed.",
    )
    return [Table("communication", "Communication", columns, rows, notes)]


def _time(scope: Scope, results: Results, dataset: str) -> list[Table]:
    stages = ("alignment", "messages", "fusion")
    rows: list[list[Cell]] = []
    for name in _collaborating(scope):
        spent = results.milliseconds(as_is(name))
        times = [spent.get(stage) for stage in stages]
        rows.append([method_title(name), aligner_title(FUSION_METHODS[name].usual_aligner), *times])
    notes = ["Medians over frames of all collaborators together, on one core, with other processes on the others."]
    alignment = results.milliseconds(as_is(scope.ours)).get("alignment")
    if alignment:
        theirs = paper.FRAMES_PER_SECOND.get(dataset)
        published = f"; the paper has {theirs} on its machine" if theirs else ""
        notes.append(f"BEVGlue, messages included: {1e3 / alignment:,.0f} frames a second{published}.")
    perception = results.perception_milliseconds()
    stage_rows: list[list[Cell]] = [[stage, milliseconds] for stage, milliseconds in perception.items()]
    stage_rows.append(["all", sum(perception.values())])
    return [
        Table("time", "Computation of a frame", ("method", "poses from", *(f"{s} [ms]" for s in stages)), rows, notes),
        Table("time_perception", "Perception of one cloud", ("stage", "median [ms]"), stage_rows),
    ]


COMMUNICATION = Experiment(
    "communication",
    "Communication",
    "Bytes that each method sends without disturbances.",
    _conditions,
    _communication,
)
TIME = Experiment(
    "time",
    "Computation time",
    "Computation time of each stage in one frame.",
    _conditions,
    _time,
)
