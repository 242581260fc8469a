"""Table 2 of the paper: every method that uses claimed poses under attack, without and with BEVGlue."""

from __future__ import annotations

from cobevglue.experiments import paper
from cobevglue.experiments.condition import Condition
from cobevglue.experiments.measure import Results
from cobevglue.experiments.table import Cell, Table
from cobevglue.experiments.tables.scope import PAPERS, Experiment, Scope, as_is, attacked, method_title

__all__ = ["ATTACK_TABLE"]


def _conditions(scope: Scope) -> list[Condition]:
    without = [attacked(name) for name in scope.trusting]
    with_bevglue = [attacked(name, "bevglue") for name in (*scope.trusting, *scope.localised)]
    given = [attacked(name, "given") for name in scope.localised]
    return [as_is("none"), *without, *with_bevglue, *given]


def _tables(scope: Scope, results: Results, dataset: str) -> list[Table]:
    published = paper.ATTACK.get(dataset, {})
    columns = ["method"]
    for quantity in ("AP@0.5 without", "AP@0.5 with", "AP@0.7 without", "AP@0.7 with", "added bytes [%]"):
        columns += [quantity] + ([f"paper {quantity}"] if published else [])
    rows = []
    for name in (*scope.trusting, *scope.localised):
        usual = attacked(name, "given" if name in scope.localised else None)
        bevglue = attacked(name, "bevglue")
        added = 100.0 * results.alignment_bytes(bevglue) / results.payload_bytes(bevglue)
        cells = [results.ap(c, iou) for iou in (0.5, 0.7) for c in (usual, bevglue)] + [added]
        row: list[Cell] = [method_title(name)]
        for number, cell in enumerate(cells):
            row.append(cell)
            if published:
                row.append(published[name][number] if name in published else None)
        rows.append(row)
    alone = as_is("none")
    last: list[Cell] = [method_title("none")]
    for value in (results.ap(alone, 0.5), None, results.ap(alone, 0.7), None, None):
        last += [value] + ([None] if published else [])
    rows.append(last)
    notes: tuple[str, ...] = (
        "Without: poses from the source of the method's paper; for CoBEVGlue's fusion the claimed ones. With: "
        "poses from BEVGlue, which receives no claimed pose.",
        "Added bytes: encoded bytes for BEVGlue, as a share of those for fusion. Features are transmitted in 16 bits.",
    )
    notes += PAPERS if published else ()
    return [Table("attack", "Same-place attack, without and with BEVGlue", columns, rows, notes)]


ATTACK_TABLE = Experiment(
    "attack",
    "Localisation attack (the paper's Table 2)",
    "Spoofed satellite signals give every collaborator the ego's position as its own.",
    _conditions,
    _tables,
)
