"""Average precision over bytes, as papers of the field draw it: every method as it is, and with features compressed."""

from __future__ import annotations

import math
from collections.abc import Iterator

from cobevglue.experiments.condition import Condition
from cobevglue.experiments.measure import Results
from cobevglue.experiments.table import Cell, Table
from cobevglue.experiments.tables.scope import Experiment, Scope, as_is, method_title
from cobevglue.fusion import FUSION_METHODS, Compression, IntermediateFusion

__all__ = ["BANDWIDTH", "bandwidth_points"]


def _rows(scope: Scope) -> Iterator[tuple[str, Condition]]:
    """Method and condition of each row, uncompressed ones first."""
    for name in scope.methods:
        yield name, as_is(name)
        kind = FUSION_METHODS[name]
        if not issubclass(kind, IntermediateFusion):
            continue
        # Aligners that filter over time are run on all frames.
        every = 1 if name in scope.localised else scope.bandwidth_every
        wanted = [(bits, cells if kind.shares_maps else 1.0) for bits, cells in scope.compressions]
        for bits, cells in dict.fromkeys(wanted):
            yield name, as_is(name, every=every, compression=Compression(bits=bits, cells=cells))


def _conditions(scope: Scope) -> list[Condition]:
    return [condition for _, condition in _rows(scope)]


def _bytes(condition: Condition, results: Results, every: int) -> float:
    """All bytes that a collaborator sends in a frame."""
    return results.payload_bytes(condition, every) + results.alignment_bytes(condition, every)


def _tables(scope: Scope, results: Results, dataset: str) -> list[Table]:
    every = scope.bandwidth_every
    rows: list[list[Cell]] = []
    for name, condition in _rows(scope):
        sent = None if name == "none" else _bytes(condition, results, every)
        compression = condition.compression
        rows.append(
            [
                method_title(name),
                FUSION_METHODS[name].kind if name != "none" else "nothing",
                None if compression is None else compression.bits,
                None if compression is None else compression.cells,
                sent,
                math.log2(sent) if sent else None,
                results.ap(condition, 0.5, every),
                results.ap(condition, 0.7, every),
            ]
        )
    columns = ("method", "sends", "bits", "cells", "bytes", "log2", "AP@0.5", "AP@0.7")
    notes = (
        f"On one frame in {every}. Bytes: all that one collaborator sends in one frame, for alignment and for fusion, "
        "mean; the bytes that are encoded.",
        "Without bits: features in float16, not coded further. With bits: quantised per channel, and run-length coded.",
        "Cells: share of the cells that are sent, those where the sender's own decoder is most confident.",
    )
    return [Table("bandwidth", "Average precision and bytes", columns, rows, notes)]


def bandwidth_points(scope: Scope, results: Results, iou: float) -> list[tuple[str, float, float]]:
    """Label, bytes and average precision of every row: for a figure. No collaboration sends nothing."""
    every = scope.bandwidth_every
    return [
        (
            method_title(name),
            0.0 if name == "none" else _bytes(condition, results, every),
            results.ap(condition, iou, every),
        )
        for name, condition in _rows(scope)
    ]


BANDWIDTH = Experiment(
    "bandwidth",
    "Average precision over bandwidth",
    "What average precision costs in bytes: every method without noise, with the poses of its paper, as it is and with "
    "its features compressed.",
    _conditions,
    _tables,
)
