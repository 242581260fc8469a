"""Table 1 of the paper: every method under localisation noise."""

from __future__ import annotations

from cobevglue.experiments import paper
from cobevglue.experiments.condition import Condition
from cobevglue.experiments.measure import Results
from cobevglue.experiments.table import Cell, Table
from cobevglue.experiments.tables.scope import PAPERS, Experiment, Scope, aligner_title, as_is, level_name, method_title
from cobevglue.fusion import FUSION_METHODS

__all__ = ["NOISE", "noise_curves"]

_GIVEN, _TRUE = "Given pose, CoBEVGlue's fusion", "True pose, CoBEVGlue's fusion"


def _rows(scope: Scope) -> dict[tuple[str, str, str], list[Condition]]:
    """By title, source of poses and name in the paper's table, a condition for each level."""
    rows = {}
    for name in scope.methods:
        source = "" if name == "none" else aligner_title(FUSION_METHODS[name].usual_aligner)
        # No collaboration is the same at every level.
        levels = [0.0] * len(scope.levels) if name == "none" else scope.levels
        rows[method_title(name), source, name] = [as_is(name, level) for level in levels]
    rows[_GIVEN, "given pose", ""] = [as_is(scope.ours, level, "given") for level in scope.levels]
    # With true poses noise makes no difference, as a test shows: run once.
    rows[_TRUE, "true pose", ""] = [as_is(scope.ours, 0.0, "given")] * len(scope.levels)
    return rows


def _conditions(scope: Scope) -> list[Condition]:
    return [condition for conditions in _rows(scope).values() for condition in conditions]


def _tables(scope: Scope, results: Results, dataset: str) -> list[Table]:
    published = paper.NOISE.get(dataset)
    columns = ["method", "poses from"]
    for level in scope.levels:
        columns += [level_name(level)] + ([f"paper {level_name(level)}"] if published else [])
    tables = []
    for iou in (0.5, 0.7):
        rows = []
        for (title, source, name), conditions in _rows(scope).items():
            row: list[Cell] = [title, source]
            for level, condition in zip(scope.levels, conditions, strict=True):
                row.append(results.ap(condition, iou))
                if published:
                    row.append(_published(published, name, iou, level))
            rows.append(row)
        notes: tuple[str, ...] = (
            "Columns: standard deviation of x and y in metres / of yaw in degrees, on the poses of all agents.",
            "CoBEVGlue is run at every level; no collaboration and true poses do not depend on it and are run once.",
        )
        notes += PAPERS if published else ()
        tables.append(Table(f"noise_ap{iou:g}", f"AP@{iou:g} under localisation noise", columns, rows, notes))
    return tables


def _published(published: dict[str, dict[float, tuple[float, ...]]], name: str, iou: float, level: float) -> Cell:
    if name not in published or level not in paper.NOISE_LEVELS:
        return None
    return published[name][iou][paper.NOISE_LEVELS.index(level)]


def noise_curves(scope: Scope, results: Results, iou: float) -> tuple[list[str], dict[str, list[float]]]:
    """Names of the levels, and by row of the table the average precision at each of them: for a figure."""
    curves = {
        title: [results.ap(condition, iou) for condition in conditions]
        for (title, _, _), conditions in _rows(scope).items()
    }
    return [level_name(level) for level in scope.levels], curves


NOISE = Experiment(
    "noise",
    "Localisation noise (the paper's Table 1)",
    "Every method with the source of poses that its paper has, under Gaussian noise on x, y and yaw of every agent, "
    "the ego's own included, drawn anew in every frame; the same draws for all methods, and scaled for all levels.",
    _conditions,
    _tables,
)
