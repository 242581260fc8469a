"""Table 3 of the paper: ablation of geometry and tracking in the matching."""

from __future__ import annotations

from cobevglue.experiments import paper
from cobevglue.experiments.condition import Condition
from cobevglue.experiments.measure import IOUS, Results, pose_quality
from cobevglue.experiments.table import Cell, Table
from cobevglue.experiments.tables.scope import PAPERS, Experiment, Scope, as_is

__all__ = ["ABLATION"]

_PRINTED = {"method": "affinity", "verdict": False}
_ANY_EDGE = {"affinity": {"position_scale": 1e6, "heading_scale": 1e6}}
"""Scales at which all edges are alike: only the boxes' sizes count."""


def _rows(scope: Scope) -> dict[tuple[str, bool, bool], Condition]:
    """By variant, and whether geometry and tracking are used."""
    name = scope.ours
    printed, alone = "as printed", {"temporal": False, "tracks": False}
    return {
        (printed, False, False): as_is(name, aligner_options={**_PRINTED, **_ANY_EDGE}, forget=True),
        (printed, True, False): as_is(name, aligner_options=_PRINTED, forget=True),
        (printed, True, True): as_is(name, aligner_options=_PRINTED),
        ("ours", True, False): as_is(name, aligner_options=alone),
        ("ours", True, True): as_is(name),
    }


def _conditions(scope: Scope) -> list[Condition]:
    return [as_is("none"), *_rows(scope).values()]


def _tables(scope: Scope, results: Results, dataset: str) -> list[Table]:
    published = paper.ABLATION.get(dataset)
    columns = ["matching", "geometry", "tracking"]
    for iou in IOUS:
        columns += [f"AP@{iou:g}"] + ([f"paper AP@{iou:g}"] if published else [])
    columns += ["refused", "wrong of accepted"]
    rows = []
    for (variant, geometry, tracking), condition in _rows(scope).items():
        row: list[Cell] = [variant, _mark(geometry), _mark(tracking)]
        for iou in IOUS:
            row.append(results.ap(condition, iou))
            if published:
                row.append(published[geometry, tracking][iou])
        quality = pose_quality([pose for _, pose in results.received_poses(condition)])
        rows.append([*row, quality.refused, quality.wrong])
    alone: list[Cell] = ["no collaboration", "", ""]
    for iou in IOUS:
        alone += [results.ap(as_is("none"), iou)] + ([None] if published else [])
    notes: tuple[str, ...] = (
        "As printed: `BEVGlueConfig.paper()`, which accepts every match; ours: the default, which refuses uncertain "
        "poses. Without geometry every pair of boxes of similar size is matched.",
        "The paper's first row is as good as no collaboration: its failed matches must have been dropped.",
    )
    notes += PAPERS if published else ()
    return [Table("ablation", "Information used by the matching", columns, [*rows, [*alone, None, None]], notes)]


def _mark(used: bool) -> str:
    return "yes" if used else "no"


ABLATION = Experiment(
    "ablation",
    "Ablation (the paper's Table 3)",
    "BEVGlue without the spatial relations between objects, and without information from earlier frames.",
    _conditions,
    _tables,
)
