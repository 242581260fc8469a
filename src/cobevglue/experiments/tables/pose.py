"""The quality of each aligner's poses."""

from __future__ import annotations

from collections.abc import Sequence

from cobevglue.experiments.condition import Condition
from cobevglue.experiments.measure import Results, pose_quality
from cobevglue.experiments.results import ReceivedPose
from cobevglue.experiments.table import Cell, Table
from cobevglue.experiments.tables.scope import Experiment, Scope, aligner_title, as_is, level_name
from cobevglue.fusion import FUSION_METHODS

__all__ = ["POSE"]

_GROUPS: dict[str, tuple[int, float]] = {
    "all": (0, float("inf")),
    "0": (0, 0),
    "1": (1, 1),
    "2": (2, 2),
    "3": (3, 3),
    "4 and more": (4, float("inf")),
}
"""Numbers of co-visible objects: first and last."""


def _sources(scope: Scope) -> dict[str, str]:
    """The first method with each source of poses."""
    sources: dict[str, str] = {}
    for name in (*scope.localised, *scope.trusting):
        sources.setdefault(FUSION_METHODS[name].usual_aligner, name)
    return sources


def _conditions(scope: Scope) -> list[Condition]:
    return [as_is(name, level) for name in _sources(scope).values() for level in scope.levels]


def _tables(scope: Scope, results: Results, dataset: str) -> list[Table]:
    rows: list[list[Cell]] = []
    for aligner, name in _sources(scope).items():
        for level in scope.levels:
            heard = [one for _, one in results.heard(as_is(name, level))]
            rows.append([aligner_title(aligner), level_name(level), *_cells(heard)])
    columns = ("poses from", "noise", *_COLUMNS)
    pairs = list(results.heard(as_is(scope.localised[0])))
    groups: list[list[Cell]] = []
    for group, (first, last) in _GROUPS.items():
        heard = [one for co_visible, one in pairs if first <= co_visible <= last]
        if heard:
            groups.append([group, *_cells(heard)])
    notes = ("Wrong: off by more than 3 m or 3°. A refusal is neither right nor wrong, and counts as no success.",)
    note = ("Co-visible: ground-truth objects that tracked boxes of both agents overlap.",)
    return [
        Table("poses", "Poses by source and localisation noise", columns, rows, notes),
        Table(
            "poses_co_visible",
            "BEVGlue by the number of co-visible objects",
            ("co-visible", *_COLUMNS),
            groups,
            note,
        ),
    ]


_COLUMNS = (
    "collaborators",
    "refused",
    "within 1 m, 1°",
    "within 2 m, 2°",
    "within 3 m, 3°",
    "wrong of accepted",
    "median error [m]",
    "median error [°]",
)


def _cells(heard: Sequence[ReceivedPose]) -> list[Cell]:
    quality = pose_quality(heard)
    shares = quality.refused, quality.success_1, quality.success_2, quality.success_3, quality.wrong
    return [quality.count, *shares, quality.translation, quality.yaw]


POSE = Experiment(
    "pose",
    "Quality of poses",
    "The relative pose of every collaborator in every frame against the true one.",
    _conditions,
    _tables,
)
