"""Measure BEVGlue's success and error rates for the relative pose of two agents, with an ablation of its options.

    python benchmarks/alignment.py                      # everything below, about 15 minutes
    python benchmarks/alignment.py --only v2v4real      # recorded detections of two real cars
    python benchmarks/alignment.py --only bodies        # the same in the cars' own frames, own vehicles given or not
    python benchmarks/alignment.py --only opv2v         # OPV2V labels with detection errors added
    python benchmarks/alignment.py --only late          # the same, lists of the other up to 0.3 s old
    python benchmarks/alignment.py --only offset        # V2V4Real with the time offset estimated or not
    python benchmarks/alignment.py --only scenes        # simulated scenes, lists of the other up to 0.3 s old
    python benchmarks/alignment.py --only scenes --scene-seeds confirmation   # the same, seeds kept apart
    python benchmarks/alignment.py --only risk          # the stated risk against the share that is wrong
    python benchmarks/alignment.py --only unrelated     # two agents that have nothing in common
    python benchmarks/alignment.py --only peers         # matchers of other papers on the same lists
    python benchmarks/alignment.py --only ablation      # each option of the default off, and the paper's own method
    python benchmarks/alignment.py --json results.json

The data is read from $COBEVGLUE_DATA (default ../shared/data). The defaults of BEVGlue were tuned on V2V4Real `train`,
OPV2V labels and the first seeds of the simulated scenes; V2V4Real `val` confirms them, with the reservations of
`cobevglue.alignment.config`. Of the simulated scenes, seeds 0 to 9 are for development and 100 to 109 for confirmation.
What "right", "wrong" and "success" mean: `cobevglue.evaluation.alignment`.
"""

from __future__ import annotations

import argparse
import dataclasses
import itertools
import json
import math
import sys
from collections.abc import Callable, Iterable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from cobevglue import BEVGlue, BEVGlueConfig
from cobevglue.alignment import Aligner
from cobevglue.datasets import OPV2V
from cobevglue.disturbance.detection_errors import DetectionErrors
from cobevglue.evaluation.alignment import AlignmentSequence, Record, by_co_visible, evaluate, off_by_3, summarise
from cobevglue.evaluation.alignment_data import (
    V2V4REAL_TRAIN,
    V2V4REAL_VAL,
    noisy_label_sequences,
    v2v4real_car_sequences,
    v2v4real_sequences,
)
from cobevglue.evaluation.scene_data import scene_sequences
from cobevglue.simulation.object_scenes import SCENES
from common import DATA, print_head
from peers import PEERS

SEEDS = (0, 1, 2)
RISK_BINS = (0.0, 0.003, 0.01, 0.03, 0.1, 0.3, 0.7, 1.0)
SCENE_SEEDS = {"development": range(10), "confirmation": range(100, 110)}
OFF = (
    "time_offset",
    "one_to_one",
    "heading_flips",
    "sizes",
    "refit",
    "temporal",
    "tracks",
    "verdict",
)

Table = list[dict[str, Any]]


def main() -> None:
    """Print the tables and, on request, write them as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=tuple(TABLES))
    parser.add_argument("--scene-seeds", choices=tuple(SCENE_SEEDS), default="development")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    print_head(f"seeds {SEEDS}")
    tables: dict[str, Table] = {}
    for name, table in TABLES.items():
        if arguments.only in (None, name):
            tables[name] = scenes(SCENE_SEEDS[arguments.scene_seeds]) if table is None else table(DATA)
            sys.stdout.flush()
    if arguments.json:
        arguments.json.write_text(json.dumps(tables, indent=1))


def v2v4real(data: Path) -> Table:
    """Recorded detections of two real cars: right and wrong by number of co-visible objects."""
    print("## V2V4Real detections, by co-visible objects (right: boxes land within 3 m)\n")
    table: Table = []
    for split, names in (("tuned on: train", V2V4REAL_TRAIN), ("confirmed on: val", V2V4REAL_VAL)):
        records = run(real_cars(data, names), BEVGlue)
        table += rows(split, records)
        if names is V2V4REAL_VAL:
            accepted = sum(r.accepted for r in records if r.sequence == "val/0001")
            table.append({"what": "val/0001 (nothing co-visible): accepted", "frames": accepted})
    everything = V2V4REAL_TRAIN + V2V4REAL_VAL + ("val/0000",)
    table += rows("all 16 sequences", run(real_cars(data, everything), BEVGlue))
    show(table)
    return table


def bodies(data: Path) -> Table:
    """Recorded detections in the cars' own frames, without and with the two cars themselves."""
    print("## V2V4Real detections in the cars' own frames, frames in which the other car is labelled\n")
    table: Table = []
    for split, names in (("train", V2V4REAL_TRAIN), ("val", V2V4REAL_VAL)):
        for given in (False, True):
            cars = data / "v2v4real_cars.csv"
            sequences = v2v4real_car_sequences(data / "v2v4real_detections", cars, names, bodies=given)
            table += rows(f"{split}, {'with' if given else 'without'} own vehicles", run(sequences, BEVGlue))
    show(table)
    return table


def opv2v(data: Path) -> Table:
    """OPV2V labels with detection errors; wrong means beyond 3 m or 3 degrees."""
    print("## OPV2V labels with detection errors (0.2 m + 0.004 m/m, 2°, 15 % missed, 4 % flipped, 1 false box)\n")
    table: Table = []
    for reach in (140.0, 50.0, 30.0):
        records = run(noisy_labels(data, reach), BEVGlue)
        table += rows(f"within {reach:.0f} m", records, wrong=off_by_3)
    show(table)
    return table


def late(data: Path) -> Table:
    """OPV2V labels with detection errors, the other's list late by a time that no agent is given."""
    print("## OPV2V labels with detection errors, within 50 m, the list of the other agent late\n")
    table: Table = []
    for frames, estimated in itertools.product((0, 1, 2, 3), (False, True)):
        config = BEVGlueConfig(time_offset=estimated)
        records = run(noisy_labels(data, 50.0, late=frames), lambda c=config: BEVGlue(c))  # type: ignore[misc]
        some = [r for r in records if r.co_visible >= 4]
        errors = [r.time_offset_error for r in records if r.accepted]
        table.append(
            {
                "late [ms]": 100 * frames,
                "offset estimated": estimated,
                "frames": len(records),
                "@1": summarise(records).success_1,
                "@1, >= 4": summarise(some).success_1,
                "@3, >= 4": summarise(some).success_3,
                "wrong of accepted": summarise(records, off_by_3).wrong_of_accepted,
                "median offset error [s]": float(np.median(errors)),
            }
        )
    show(table)
    return table


def offset(data: Path) -> Table:
    """V2V4Real with the time offset estimated or not, in a made-up frame and in the cars' own frames."""
    print("## V2V4Real train, time offset estimated or not (wrong: boxes land 3 m or more off)\n")
    table: Table = []
    folder, cars = data / "v2v4real_detections", data / "v2v4real_cars.csv"
    for estimated in (False, True):
        config = BEVGlueConfig(time_offset=estimated)
        for what, sequences in (
            ("constant frame", real_cars(data, V2V4REAL_TRAIN)),
            ("moving frame", real_cars(data, V2V4REAL_TRAIN, moving=True)),
            ("own frames, with bodies", v2v4real_car_sequences(folder, cars, V2V4REAL_TRAIN, bodies=True)),
        ):
            records = run(sequences, lambda c=config: BEVGlue(c))  # type: ignore[misc]
            table += rows(f"{what}, offset {'estimated' if estimated else 'taken as 0'}", records)
    show(table)
    return table


def scenes(seeds: range) -> Table:
    """Simulated scenes with own vehicles given, the other's list late by a time that no agent is given."""
    print(f"## Simulated scenes, seeds {seeds[0]} to {seeds[-1]}, the list of the other agent late (wrong: 3 m off)\n")
    table: Table = []
    for name, delay in itertools.product(SCENES, (0.0, 0.1, 0.2, 0.3)):
        sequences = list(scene_sequences(name, seeds, delay))
        for estimated in (False, True):
            config = BEVGlueConfig(time_offset=estimated)
            records = run(sequences, lambda c=config: BEVGlue(c))  # type: ignore[misc]
            summary = summarise(records)
            errors = [r.time_offset_error for r in records if r.accepted]
            table.append(
                {
                    "scene": name,
                    "late [ms]": round(1e3 * delay),
                    "offset estimated": estimated,
                    "frames": summary.frames,
                    "right": summary.right,
                    "wrong of accepted": summary.wrong_of_accepted,
                    "refused": summary.refused,
                    "median offset error [s]": float(np.median(errors)) if errors else math.nan,
                }
            )
        print(f"   … {name}, {1e3 * delay:.0f} ms", file=sys.stderr)
    show(table)
    return table


def risk(data: Path) -> Table:
    """The stated risk of the best pose, accepted or not, against the share that is wrong, and the pose errors' NEES."""
    print("## Stated risk against the share wrong (boxes 3 m or more off), refused poses included\n")
    folder, cars = data / "v2v4real_detections", data / "v2v4real_cars.csv"
    sets = {
        "V2V4Real train, constant frame": real_cars(data, V2V4REAL_TRAIN, SEEDS[:1]),
        "V2V4Real train, own frames": v2v4real_car_sequences(folder, cars, V2V4REAL_TRAIN, bodies=True),
        "V2V4Real val, constant frame": real_cars(data, V2V4REAL_VAL, SEEDS[:1]),
        "V2V4Real val, own frames": v2v4real_car_sequences(folder, cars, V2V4REAL_VAL, bodies=True),
        "OPV2V labels, 50 m": noisy_labels(data, 50.0),
    }
    table: Table = []
    for what, sequences in sets.items():
        records = run(sequences, lambda: BEVGlue(BEVGlueConfig(verdict=False)))
        judged = [r for r in records if r.accepted and r.risk < 1.0]
        for low, high in itertools.pairwise(RISK_BINS):
            some = [r for r in judged if low <= r.risk < high]
            stated = float(np.mean([r.risk for r in some])) if some else math.nan
            wrong = float(np.mean([not r.right for r in some])) if some else math.nan
            bounds = f"{low} to {high}"
            table.append({"what": what, "risk": bounds, "frames": len(some), "stated": stated, "wrong": wrong})
        nees = [r.nees for r in judged if r.risk < BEVGlueConfig().risk and r.right]
        table.append(
            {"what": what, "risk": "median NEES, 3 degrees of freedom (2.37)", "stated": float(np.median(nees))}
        )
    show(table)
    return table


def unrelated(data: Path) -> Table:
    """Ego of one recorded sequence with other of another: everything that is accepted is wrong."""
    print("## Unrelated agents (V2V4Real train: ego of one sequence, other of another)\n")
    sequences = real_cars(data, V2V4REAL_TRAIN, SEEDS[:1])
    records = []
    for a, b in itertools.permutations(sequences, 2):
        frames = [
            dataclasses.replace(ego, other=other.other, co_visible=0)
            for ego, other in zip(a.frames[:150], b.frames[-150:], strict=False)
        ]
        for frame, record in zip(frames, run([AlignmentSequence("unrelated", frames)], BEVGlue), strict=True):
            records.append((len(frame.ego) * len(frame.other), record.accepted))
    table: Table = []
    for low, high in ((0, 24), (25, 99), (100, 224), (225, 9999), (0, 9999)):
        accepted = [accepted for pairs, accepted in records if low <= pairs <= high]
        share = sum(accepted) / len(accepted)
        table.append({"pairs of boxes": f"{low} to {high}", "frames": len(accepted), "accepted": share})
    show(table)
    return table


def ablation(data: Path) -> Table:
    """Each option of the default off, and the paper's own method."""
    print("## Ablation\n")
    variants = {"robust default": BEVGlueConfig()}
    variants |= {f"without {option}": BEVGlueConfig().model_copy(update={option: False}) for option in OFF}
    variants["with range_tolerance"] = BEVGlueConfig(range_tolerance=True)
    variants["without absence"] = BEVGlueConfig(absence=0.0)
    variants["paper()"] = BEVGlueConfig.paper()
    real = [s for seed in SEEDS[:1] for s in real_cars(data, V2V4REAL_TRAIN + V2V4REAL_VAL, (seed,))]
    simulated = noisy_labels(data, 50.0)
    table: Table = []
    for name, config in variants.items():
        records = run(real, lambda c=config: BEVGlue(c))  # type: ignore[misc]
        labels = run(simulated, lambda c=config: BEVGlue(c))  # type: ignore[misc]
        two, four = ([r for r in records if r.co_visible >= k] for k in (2, 4))
        some = [r for r in labels if r.co_visible >= 4]
        table.append(
            {
                "what": name,
                "V2V4Real right >= 2": summarise(two).right,
                "right >= 4": summarise(four).right,
                "wrong of accepted": summarise(records).wrong_of_accepted,
                "OPV2V 50 m @1": summarise(some).success_1,
                "@3": summarise(some).success_3,
                "wrong": summarise(labels, off_by_3).wrong_of_accepted,
                "ms": summarise(records).median_milliseconds,
            }
        )
        print(f"   … {name}", file=sys.stderr)
    show(table)
    return table


def peers(data: Path) -> Table:
    """Matchers of other papers (`benchmarks/peers`), the paper's own and BEVGlue on the same lists."""
    print("## Peers: V2V4Real val and train 0006 to 0010 (right: boxes land within 3 m); OPV2V labels with detection")
    print("errors within 50 m (right: within 3 m, 3°). alone: every frame is a sequence of its own\n")
    methods: dict[str, tuple[bool, Callable[[], Aligner]]] = {name: (True, peer) for name, peer in PEERS.items()}
    methods |= {f"{name}, published settings": (True, peer.published) for name, peer in PEERS.items()}
    for name, config in (("the paper's star", BEVGlueConfig.paper()), ("BEVGlue", BEVGlueConfig())):
        methods |= {f"{name}, alone": (True, partial(BEVGlue, config)), name: (False, partial(BEVGlue, config))}
    real = real_cars(data, V2V4REAL_VAL + V2V4REAL_TRAIN[6:], SEEDS[:1])
    labels = noisy_labels(data, 50.0)
    table: Table = []
    for name, (alone, make_aligner) in methods.items():
        on_real, on_labels = (run(each_alone(s) if alone else s, make_aligner) for s in (real, labels))
        val = [r for r in on_real if r.sequence.startswith("val")]
        parts: tuple[tuple[str, list[Record], Callable[[Record], bool]], ...] = (
            ("V2V4Real", on_real, lambda r: not r.right),
            ("V2V4Real, val only", val, lambda r: not r.right),
            ("OPV2V, 50 m", on_labels, off_by_3),
        )
        for what, records, wrong in parts:
            two, four = ([r for r in records if r.co_visible >= k] for k in (2, 4))
            summary = summarise(records, wrong)
            table.append(
                {
                    "method": name,
                    "data": what,
                    "frames": len(records),
                    "right >= 2": float(np.mean([not wrong(r) for r in two])),
                    "right >= 4": float(np.mean([not wrong(r) for r in four])),
                    "wrong of accepted": summary.wrong_of_accepted,
                    "refused": summary.refused,
                    "ms": summary.median_milliseconds,
                }
            )
        print(f"   … {name}", file=sys.stderr)
    show(table)
    return table


def each_alone(sequences: Iterable[AlignmentSequence]) -> list[AlignmentSequence]:
    """Every frame as a sequence of its own, so that nothing is remembered."""
    return [AlignmentSequence(s.name, [frame]) for s in sequences for frame in s.frames]


def real_cars(
    data: Path, names: tuple[str, ...], seeds: tuple[int, ...] = SEEDS, moving: bool = False
) -> list[AlignmentSequence]:
    """The recorded sequences, once for each trajectory of the other car's frame."""
    return [s for seed in seeds for s in v2v4real_sequences(data / "v2v4real_detections", names, seed, moving=moving)]


def noisy_labels(data: Path, reach: float, late: int = 0) -> list[AlignmentSequence]:
    """All agent pairs of the OPV2V scenarios, once for each seed of the errors."""
    labels = OPV2V(data / "opv2v", "test_culvercity")
    return [s for seed in SEEDS for s in noisy_label_sequences(labels, DetectionErrors(), seed, reach, late)]


def run(sequences: Iterable[AlignmentSequence], make_aligner: Callable[[], Aligner]) -> list[Record]:
    """All records of an aligner on these sequences."""
    return list(evaluate(sequences, make_aligner))


def rows(what: str, records: list[Record], wrong: Callable[[Record], bool] = lambda r: not r.right) -> Table:
    """One row for each number of co-visible objects and for the sums the README reports."""
    groups = by_co_visible(records, wrong)
    return [{"what": what, "co-visible": name, **dataclasses.asdict(group)} for name, group in groups.items()]


def show(table: Table) -> None:
    """A Markdown table."""
    columns = list(dict.fromkeys(column for line in table for column in line))
    print("| " + " | ".join(columns) + " |\n|" + " --- |" * len(columns))
    for line in table:
        cells = (line.get(column, "") for column in columns)
        print("| " + " | ".join(f"{cell:.4f}" if isinstance(cell, float) else str(cell) for cell in cells) + " |")
    print()


TABLES: dict[str, Callable[[Path], Table] | None] = {
    "v2v4real": v2v4real,
    "bodies": bodies,
    "opv2v": opv2v,
    "late": late,
    "offset": offset,
    "scenes": None,  # takes seeds instead of data
    "risk": risk,
    "unrelated": unrelated,
    "peers": peers,
    "ablation": ablation,
}

if __name__ == "__main__":
    main()
