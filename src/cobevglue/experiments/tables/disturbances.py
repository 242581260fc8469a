"""Disturbances beyond the paper: other attacks, lost and late messages."""

from __future__ import annotations

from typing import Any

from cobevglue.experiments.condition import Condition
from cobevglue.experiments.measure import Results, pose_quality
from cobevglue.experiments.table import Cell, Table
from cobevglue.experiments.tables.scope import Experiment, Scope, aligner_title, as_is, method_title
from cobevglue.fusion import FUSION_METHODS

__all__ = ["FURTHER"]

_FURTHER: dict[str, dict[str, Any]] = {
    "nothing": {},
    "poses replayed from 1 s ago": {"disturbance": "replay", "disturbance_options": {"seconds": 1.0}},
    "poses off by 3 m, −2 m, 3°": {
        "disturbance": "offset",
        "disturbance_options": {"x": 3.0, "y": -2.0, "yaw": 3.0},
    },
    "10 fabricated boxes": {"disturbance": "fabricated", "disturbance_options": {"count": 10, "reach": 40.0}},
    "30 % of messages lost": {"disturbance": "loss", "disturbance_options": {"probability": 0.3}},
    "100 ms late": {"disturbance": "delay", "disturbance_options": {"seconds": 0.1}},
    "200 ms late": {"disturbance": "delay", "disturbance_options": {"seconds": 0.2}},
    "300 ms late": {"disturbance": "delay", "disturbance_options": {"seconds": 0.3}},
}


def _rows(scope: Scope) -> dict[str, dict[str, Any]]:
    """By title, the method and its aligner: CoBEVGlue, its fusion on given poses, boxes on given poses, CoAlign."""
    ours = scope.ours
    rows: dict[str, dict[str, Any]] = {
        method_title(ours): {"fusion": ours},
        "Given pose, CoBEVGlue's fusion": {"fusion": ours, "aligner": "given"},
    }
    for name in ("late", "coalign"):
        if name in scope.methods:
            rows[f"{method_title(name)}, {aligner_title(FUSION_METHODS[name].usual_aligner)}"] = {"fusion": name}
    return rows


def _condition(scope: Scope, row: dict[str, Any], what: dict[str, Any]) -> Condition:
    remembers = "aligner" not in row and row["fusion"] in scope.localised
    # As in the other tables where nothing goes wrong, so that it is run once.
    return as_is(**row, **what, every=1 if remembers or not what else scope.trusting_every)


def _conditions(scope: Scope) -> list[Condition]:
    rows = [_condition(scope, row, what) for row in _rows(scope).values() for what in _FURTHER.values()]
    return [as_is("none"), *rows]


def _tables(scope: Scope, results: Results, dataset: str) -> list[Table]:
    every = scope.trusting_every
    tables = []
    for iou in (0.5, 0.7):
        rows: list[list[Cell]] = []
        for title, what in _FURTHER.items():
            cells = [results.ap(_condition(scope, row, what), iou, every) for row in _rows(scope).values()]
            rows.append([title, *cells])
        rows.append(["no collaboration", results.ap(as_is("none"), iou, every), *[None] * (len(_rows(scope)) - 1)])
        title = f"AP@{iou:g} under further disturbances"
        notes = (f"On one frame in {every}; CoBEVGlue, which filters over time, is run on all frames.",)
        tables.append(Table(f"disturbances_ap{iou:g}", title, ("disturbance", *_rows(scope)), rows, notes))
    ours = scope.ours
    rows = []
    for title, what in _FURTHER.items():
        condition = _condition(scope, {"fusion": ours}, what)
        quality = pose_quality([pose for _, pose in results.received_poses(condition)])
        rows.append([title, quality.count, quality.refused, quality.wrong, quality.success_1, quality.success_3])
    columns = ("disturbance", "received", "refused", "wrong of accepted", "within 1 m, 1°", "within 3 m, 3°")
    return [*tables, Table("disturbances_poses", "BEVGlue's poses under disturbances", columns, rows)]


FURTHER = Experiment(
    "disturbances",
    "Further disturbances",
    "Replayed and constantly wrong localisation, fabricated boxes (added to the transmitted boxes, "
    "not to the features), lost messages and late ones. The pose of a late message is compared with the true pose at "
    "the time of the message.",
    _conditions,
    _tables,
)
