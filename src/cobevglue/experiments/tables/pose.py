"""Pose errors and refusals of each aligner."""

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
"""Least and greatest number of co-visible objects of each group."""


def _sources(scope: Scope) -> dict[str, str]:
    """The first method that uses each source of poses."""
    sources: dict[str, str] = {}
    for name in (scope.ours, *scope.trusting):
        sources.setdefault(FUSION_METHODS[name].usual_aligner, name)
    return sources


def _conditions(scope: Scope) -> list[Condition]:
    return [as_is(name, level) for name in _sources(scope).values() for level in scope.levels]


def _tables(scope: Scope, results: Results, dataset: str) -> list[Table]:
    rows: list[list[Cell]] = []
    for aligner, name in _sources(scope).items():
        for level in scope.levels:
            poses = [pose for _, pose in results.received_poses(as_is(name, level))]
            rows.append([aligner_title(aligner), level_name(level), *_cells(poses)])
    columns = ("poses from", "noise", *_COLUMNS)
    pairs = list(results.received_poses(as_is(scope.ours)))
    groups: list[list[Cell]] = []
    for group, (first, last) in _GROUPS.items():
        poses = [pose for co_visible, pose in pairs if first <= co_visible <= last]
        if poses:
            groups.append([group, *_cells(poses)])
    notes = ("Wrong: an error of 3 m, 3° or more. A refusal is neither right nor wrong, and not a success.",)
    note = ("Co-visible: ground-truth objects that overlap with tracked boxes of both agents.",)
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


def _cells(poses: Sequence[ReceivedPose]) -> list[Cell]:
    quality = pose_quality(poses)
    shares = quality.refused, quality.success_1, quality.success_2, quality.success_3, quality.wrong
    return [quality.count, *shares, quality.translation, quality.yaw]


POSE = Experiment(
    "pose",
    "Quality of poses",
    "The relative pose of every collaborator in every frame against the true one.",
    _conditions,
    _tables,
)
