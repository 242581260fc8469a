"""Figure 4 of the paper: average precision against communication, for BEVGlue and for registration of points."""

from __future__ import annotations

from cobevglue.experiments.condition import Condition
from cobevglue.experiments.measure import Results, pose_quality
from cobevglue.experiments.table import Cell, Table
from cobevglue.experiments.tables.scope import Experiment, Scope, aligner_title, as_is, method_title, needs

__all__ = ["REGISTRATION", "registration_points"]


def _levels(scope: Scope, aligner: str) -> list[float | None]:
    """Noise of the initial pose; None for aligners without one."""
    return [*scope.registration_levels] if needs(aligner, "pose") else [None]


def _rows(scope: Scope) -> dict[tuple[str, str], Condition]:
    """By aligner and level of the initial pose's noise, in order of budget."""
    rows = {}
    for aligner in scope.registrations:
        for level in _levels(scope, aligner):
            for budget in scope.budgets:
                label = (
                    aligner_title(aligner) if level is None else f"{aligner_title(aligner)}, initial pose ±{level:g}"
                )
                rows[label, f"{budget}"] = as_is(
                    scope.ours,
                    level or 0.0,
                    aligner,
                    aligner_options={"budget_bytes": budget},
                    every=scope.registration_every,
                )
    return rows


def _conditions(scope: Scope) -> list[Condition]:
    return [as_is("none"), as_is(scope.ours), as_is(scope.ours, 0.0, "given"), *_rows(scope).values()]


def _all_rows(scope: Scope) -> dict[tuple[str, str], Condition]:
    bevglue = {("BEVGlue", ""): as_is(scope.ours)}
    alone = {(method_title("none"), ""): as_is("none")}
    return {**bevglue, **_rows(scope), **alone, ("True pose", ""): as_is(scope.ours, 0.0, "given")}


def _tables(scope: Scope, results: Results, dataset: str) -> list[Table]:
    every = scope.registration_every
    rows: list[list[Cell]] = []
    for (label, budget), condition in _all_rows(scope).items():
        sent = label not in (method_title("none"), "True pose")
        quality = pose_quality([pose for _, pose in results.received_poses(condition, every)])
        milliseconds = results.milliseconds(condition).get("alignment") if sent else None
        rows.append(
            [
                label,
                int(budget) if budget else None,
                results.alignment_bytes(condition, every) if sent else None,
                results.ap(condition, 0.5, every),
                results.ap(condition, 0.7, every),
                quality.refused if sent else None,
                quality.success_1 if sent else None,
                quality.success_3 if sent else None,
                milliseconds,
            ]
        )
    columns = (
        "poses from",
        "budget [bytes]",
        "sent [bytes]",
        "AP@0.5",
        "AP@0.7",
        "refused",
        "within 1 m, 1°",
        "within 3 m, 3°",
        "time [ms]",
    )
    notes = (
        f"CoBEVGlue's fusion on one frame in {every}; bytes are of one collaborator in one frame, for alignment only.",
        "A sampled cloud may be smaller than the budget.",
        "Initial pose: ICP starts from claimed poses with this noise, in metres and degrees on every agent; the others "
        "need none.",
    )
    return [Table("registration", "Registration of points against BEVGlue", columns, rows, notes)]


def registration_points(scope: Scope, results: Results, iou: float) -> list[tuple[str, float, float]]:
    """Label, bytes and average precision of every row: for a figure. The ego alone sends nothing."""
    every = scope.registration_every
    points = []
    for (label, _), condition in _all_rows(scope).items():
        if label == "True pose":
            continue
        size = 0.0 if label == method_title("none") else results.alignment_bytes(condition, every)
        points.append((label, size, results.ap(condition, iou, every)))
    return points


REGISTRATION = Experiment(
    "registration",
    "Registration of points (the paper's Figure 4)",
    "Instead of boxes, collaborators send points, sampled to fit a budget, and the ego registers them.",
    _conditions,
    _tables,
)
