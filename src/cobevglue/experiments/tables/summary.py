"""The main results, with a column for each data set."""

from __future__ import annotations

from collections.abc import Mapping

from cobevglue.experiments.condition import Condition
from cobevglue.experiments.measure import Results
from cobevglue.experiments.table import Cell, Table
from cobevglue.experiments.tables.scope import Scope, as_is, attacked, level_name, method_title

__all__ = ["summary"]


def summary(scope: Scope, parts: Mapping[str, Results]) -> Table:
    """The main results of each data set; rows whose conditions were not run are left out.

    Args:
        scope: of the study.
        parts: the results by the name of their data.
    """
    ours = scope.ours
    worst = scope.levels[-1]
    asked: dict[str, Condition] = {
        "no collaboration": as_is("none"),
        "CoBEVGlue, no noise": as_is(ours),
        f"CoBEVGlue, noise {level_name(worst)}": as_is(ours, worst),
        "CoBEVGlue, same-place attack": attacked(ours, "bevglue"),
        "true pose": as_is(ours, 0.0, "given"),
        f"given pose, noise {level_name(worst)}": as_is(ours, worst, "given"),
        "given pose, same-place attack": attacked(ours, "given"),
    }
    rows: list[list[Cell]] = [
        ["frames", *(results.frame_count for results in parts.values())],
        ["evaluated objects", *(results.object_count for results in parts.values())],
    ]
    for iou in (0.5, 0.7):
        for title, condition in asked.items():
            if all(results.has(condition) for results in parts.values()):
                rows.append([f"AP@{iou:g}, {title}", *(results.ap(condition, iou) for results in parts.values())])
    below = [_below(scope, results) for results in parts.values()]
    if all(cell is not None for cell in below):
        rows.append([f"methods below no collaboration at {level_name(worst)} (AP@0.5)", *below])
    again = [_above_again(scope, results) for results in parts.values()]
    if all(cell is not None for cell in again):
        rows.append(["methods above it under attack without → with BEVGlue (AP@0.5)", *again])
    return Table("summary", "In short", ("", *parts), rows)


def _below(scope: Scope, results: Results) -> str | None:
    """The methods that are worse than no collaboration under the strongest noise."""
    conditions = {name: as_is(name, scope.levels[-1]) for name in scope.trusting}
    if not all(results.has(condition) for condition in (*conditions.values(), as_is("none"))):
        return None
    alone = results.ap(as_is("none"), 0.5)
    worse = [method_title(name) for name, condition in conditions.items() if results.ap(condition, 0.5) < alone]
    return f"{len(worse)} of {len(conditions)}" + (f": {', '.join(worse)}" if worse else "")


def _above_again(scope: Scope, results: Results) -> str | None:
    """Number of methods that are better than no collaboration under attack, without and with BEVGlue."""
    pairs = [(attacked(name), attacked(name, "bevglue")) for name in scope.trusting]
    if not all(results.has(condition) for pair in pairs for condition in pair) or not results.has(as_is("none")):
        return None
    alone = results.ap(as_is("none"), 0.5)
    without, with_bevglue = (sum(results.ap(pair[i], 0.5) > alone for pair in pairs) for i in (0, 1))
    return f"{without} → {with_bevglue} of {len(pairs)}"
