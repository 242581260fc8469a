"""`cobevglue evaluate --task align`: BEVGlue on the labels of a data set."""

from __future__ import annotations

import dataclasses
from pathlib import Path

from cobevglue.cli.errors import InputError, expected_errors
from cobevglue.cli.output import print_json, print_note, print_table

__all__ = ["evaluate_align"]


def evaluate_align(
    root: Path,
    dataset: str,
    split: str,
    *,
    max_range: float,
    perfect: bool,
    paper: bool,
    seed: int,
    as_json: bool,
) -> None:
    """Evaluate every pair of agents on labels with detection errors, and print a summary by co-visible objects."""
    from cobevglue import BEVGlue, BEVGlueConfig
    from cobevglue.datasets import OPV2V, V2XSet
    from cobevglue.disturbance.detection_errors import DetectionErrors
    from cobevglue.evaluation.alignment import by_co_visible, evaluate, off_by_3
    from cobevglue.evaluation.alignment_data import noisy_label_sequences

    readers = {"opv2v": OPV2V, "v2xset": V2XSet}
    if dataset not in readers:
        raise InputError(f"--dataset {dataset}: --task align needs exact poses and object ids: {', '.join(readers)}")
    errors = DetectionErrors.none() if perfect else DetectionErrors()
    config = BEVGlueConfig.paper() if paper else BEVGlueConfig()
    records = []
    with expected_errors():
        for sequence in noisy_label_sequences(readers[dataset](root, split), errors, seed, max_range):
            records += list(evaluate([sequence], lambda: BEVGlue(config)))
            print_note(f"{sequence.name}: {len(sequence.frames)} frames")
    groups = by_co_visible(records, off_by_3)
    if as_json:
        print_json({name: dataclasses.asdict(group) for name, group in groups.items()})
        return
    print_table(
        f"BEVGlue on {dataset} {split}, objects within {max_range:.0f} m",
        ("co-visible", "frames", "@1", "@2", "@3", "refused", "wrong of accepted", "precision", "recall", "ms"),
        [
            (
                name,
                str(g.frames),
                *(f"{100 * share:.1f} %" for share in (g.success_1, g.success_2, g.success_3, g.refused)),
                f"{100 * g.wrong_of_accepted:.2f} %",
                f"{100 * g.match_precision:.1f} %",
                f"{100 * g.match_recall:.1f} %",
                f"{g.median_milliseconds:.2f}",
            )
            for name, g in groups.items()
        ],
    )
