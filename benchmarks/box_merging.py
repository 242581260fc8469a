"""Average precision of features, boxes and both together: true poses, BEVGlue's poses, invented boxes, late messages.

    python benchmarks/box_merging.py                               # twelve simulated test sequences, 240 frames
    python benchmarks/box_merging.py --split validation --seed 77   # what the reliabilities were chosen on

Results of finished sequences are kept in `--out`, so that an interrupted run resumes.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from cobevglue.experiments.condition import Condition
from cobevglue.experiments.measure import Results
from cobevglue.experiments.models import Models
from cobevglue.experiments.runner import run_study
from cobevglue.experiments.study import SEED, StudySettings
from common import print_head

_FUSIONS = {"late fusion": "late", "features": "cobevglue-features", "features and boxes": "cobevglue"}
_COLUMNS: dict[str, dict[str, Any]] = {
    "true poses": {"aligner": "given"},
    "BEVGlue": {"aligner": "bevglue"},
    "BEVGlue, 10 invented boxes": {
        "aligner": "bevglue",
        "disturbance": "fabricated",
        "disturbance_options": {"count": 10, "reach": 40.0},
    },
    "BEVGlue, 200 ms late": {
        "aligner": "bevglue",
        "disturbance": "delay",
        "disturbance_options": {"seconds": 0.2},
    },
}


def main() -> None:
    """Run the study, and print a Markdown table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--split", default="test")
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--sequences", type=int, default=12)
    parser.add_argument("--out", type=Path, default=Path("runs/box_merging"))
    arguments = parser.parse_args()
    settings = StudySettings(split=arguments.split, seed=arguments.seed, scenarios=arguments.sequences)
    alone = Condition(fusion="none", aligner="given")
    table = {
        title: [Condition(fusion=fusion, **column) for column in _COLUMNS.values()]
        for title, fusion in _FUSIONS.items()
    }
    conditions = [alone, *(condition for row in table.values() for condition in row)]
    runs = run_study(
        settings,
        conditions,
        arguments.out / f"{arguments.split}_{arguments.seed}",
        progress=lambda done, total: print(f"\r{done / total:6.1%}", end="", flush=True),
    )
    results = Results(runs, Models(settings).evaluation_range, settings.min_points)
    print("\r", end="")
    print_head(f"split {settings.split}, seed {settings.seed}, {results.frame_count} frames, AP 0.5 / 0.7")
    print("| | " + " | ".join(_COLUMNS) + " |\n|" + " --- |" * (1 + len(_COLUMNS)))
    print("| no collaboration | " + " | ".join([_ap(results, alone)] * len(_COLUMNS)) + " |")
    for title, row in table.items():
        print(f"| {title} | " + " | ".join(_ap(results, condition) for condition in row) + " |")


def _ap(results: Results, condition: Condition) -> str:
    return f"{results.ap(condition, 0.5):.3f} / {results.ap(condition, 0.7):.3f}"


if __name__ == "__main__":
    main()
