"""How often `MisbehaviourDetector` finds lists that were tampered with, and how often it reports honest ones.

    python benchmarks/misbehaviour.py                        # on the development data
    python benchmarks/misbehaviour.py --data confirmation    # on the data kept apart
    python benchmarks/misbehaviour.py --only V2V4Real        # or scenes
    python benchmarks/misbehaviour.py --json results.json
    python benchmarks/misbehaviour.py --picture docs/images/misbehaviour.png   # only the picture of docs/trust.md

Drives of up to 15 s: V2V4Real in the cars' own frames with own vehicles (development: train, confirmation: val), cut
into parts, and simulated scenes of 8 s with lists 0.1 s late (seeds 0 to 3; 100 to 107). The other agent's list is
tampered with from 3 s on, before it is aligned. The data is read from $COBEVGLUE_DATA (default ../shared/data).
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from alignment import show
from cobevglue import BEVGlue, Boxes
from cobevglue.alignment.own_body import known_bodies
from cobevglue.evaluation.alignment import AlignmentSequence, PairFrame
from cobevglue.evaluation.alignment_data import V2V4REAL_TRAIN, V2V4REAL_VAL, v2v4real_car_sequences
from cobevglue.evaluation.scene_data import scene_sequence
from cobevglue.misbehaviour import MisbehaviourDetector, MisbehaviourReport
from cobevglue.simulation.object_scenes import SCENES
from common import DATA, print_head

SCENE_SEEDS = {"development": range(4), "confirmation": range(100, 108)}
SEQUENCES = {"development": V2V4REAL_TRAIN, "confirmation": V2V4REAL_VAL}
PART, START = 150, 30
"""Frames of a drive, and the first that is tampered with."""
REACH, SHIFT, OLD = 30.0, 4.0, 20

Table = list[dict[str, Any]]
Tamper = Callable[[list[PairFrame], int, np.random.Generator], Boxes]


def main() -> None:
    """Print the tables and, on request, write them as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", choices=tuple(SEQUENCES), default="development")
    parser.add_argument("--only", choices=("V2V4Real", "scenes"))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    if arguments.picture:
        draw(arguments.picture)
        return
    print_head(f"{arguments.data} data")
    table: Table = []
    for source, load in (("V2V4Real", real_drives), ("scenes", scene_drives)):
        drives = load(arguments.data) if arguments.only in (None, source) else []
        for name, tamper in ATTACKS.items() if drives else ():
            table.append(row(source, name, drives, tamper))
            print("   …", table[-1], file=sys.stderr)
    show(table)
    if arguments.json:
        arguments.json.write_text(json.dumps(table, indent=1))


def real_drives(which: str) -> list[list[PairFrame]]:
    """Parts of the V2V4Real sequences."""
    sequences = v2v4real_car_sequences(
        DATA / "v2v4real_detections", DATA / "v2v4real_cars.csv", SEQUENCES[which], bodies=True
    )
    return [part for sequence in sequences for part in parts(sequence)]


def parts(sequence: AlignmentSequence) -> list[list[PairFrame]]:
    """A sequence in parts, without the rest that is shorter than 10 s."""
    frames = sequence.frames
    return [frames[i : i + PART] for i in range(0, len(frames), PART) if len(frames[i : i + PART]) >= 100]


def scene_drives(which: str) -> list[list[PairFrame]]:
    """Simulated scenes."""
    return [scene_sequence(name, seed, delay=0.1).frames for name in SCENES for seed in SCENE_SEEDS[which]]


def row(source: str, name: str, drives: list[list[PairFrame]], tamper: Tamper) -> dict[str, Any]:
    """One attack on all drives."""
    delays, before, names, accepted, frames, excluded = [], 0, [], 0, 0, 0
    for index, drive in enumerate(drives):
        first, sure = math.inf, False
        for i, (report, aligned) in enumerate(run(drive, tamper, index)):
            accepted += aligned
            frames += 1
            sure |= report.exclude
            if report.misbehaving and first == math.inf:
                first = i
                names.append(report.observations[0].name)
        before += first < START
        excluded += sure
        delays.append(0.1 * (first - START + 1) if first >= START else math.inf)
    delay = np.array(delays)
    return {
        "data": source,
        "tampered": name,
        "drives": len(drives),
        "reported": float(np.isfinite(delay).mean()),
        "excluded": excluded / len(drives),
        "within 2 s": float((delay <= 2.0 + 1e-9).mean()),
        "median delay [s]": float(np.median(delay)),
        "before the attack": before,
        "most named": max(set(names), key=names.count) if names else "",
        "aligned": accepted / frames,
    }


def run(drive: list[PairFrame], tamper: Tamper, index: int) -> list[tuple[MisbehaviourReport, bool]]:
    """The report of every frame, and whether the alignment was accepted."""
    glue, detector, found = BEVGlue(), MisbehaviourDetector(), []
    for i, frame in enumerate(drive):
        other = frame.other if i < START else tamper(drive, i, np.random.default_rng([0, 84, index]))
        alignment = glue.align(frame.ego, other, frame.time, **known_bodies(frame.ego_body, frame.other_body))
        found.append((detector.update(frame.ego, other, alignment, frame.time), alignment.accepted))
    return found


def honest(drive: list[PairFrame], i: int, rng: np.random.Generator) -> Boxes:
    """The list as it is."""
    return drive[i].other


def invent(count: int) -> Tamper:
    """Add fabricated cars that move with the other agent."""

    def tamper(drive: list[PairFrame], i: int, rng: np.random.Generator) -> Boxes:
        distance, bearing = REACH * np.sqrt(rng.uniform(0.05, 1.0, count)), rng.uniform(-math.pi, math.pi, count)
        other = drive[i].other
        z = float(np.median(other.center[:, 2])) if len(other) else -1.0
        more = Boxes(
            np.column_stack([distance * np.cos(bearing), distance * np.sin(bearing), np.full(count, z)]),
            np.tile((4.5, 1.9, 1.6), (count, 1)),
            rng.uniform(-math.pi, math.pi, count),
            track_id=10**6 + np.arange(count),
        )
        # The detector's noise: boxes that never move against each other would be found by that alone.
        jitter = np.random.default_rng([0, 85, i]).normal(0.0, 0.1, more.center.shape)
        more = more.replace(center=more.center + jitter)
        return Boxes.concatenate([other.replace(score=None, label=None), more])

    return tamper


def chosen(drive: list[PairFrame], share: float, rng: np.random.Generator) -> set[int]:
    """Track ids of a share of all objects."""
    ids = sorted({int(key) for frame in drive for key in (frame.other.track_id if len(frame.other) else ())})  # type: ignore[union-attr]
    return {key for key in ids if rng.random() < share}


def remove(share: float) -> Tamper:
    """Remove a share of the objects."""

    def tamper(drive: list[PairFrame], i: int, rng: np.random.Generator) -> Boxes:
        some, other = chosen(drive, share, rng), drive[i].other
        return other[[int(key) not in some for key in other.track_id]] if len(other) else other  # type: ignore[union-attr]

    return tamper


def shift(share: float) -> Tamper:
    """A share of the objects is shifted by `SHIFT`, each in a direction of its own."""

    def tamper(drive: list[PairFrame], i: int, rng: np.random.Generator) -> Boxes:
        some, other = chosen(drive, share, rng), drive[i].other
        center = other.center.copy()
        for k, key in enumerate(other.track_id if len(other) else ()):  # type: ignore[arg-type]
            if int(key) in some:
                turn = np.random.default_rng([0, 86, int(key)]).uniform(-math.pi, math.pi)
                center[k, :2] += SHIFT * math.cos(turn), SHIFT * math.sin(turn)
        return other.replace(center=center)

    return tamper


def replay(drive: list[PairFrame], i: int, rng: np.random.Generator) -> Boxes:
    """The list of 2 s ago."""
    return drive[i - OLD].other


ATTACKS: dict[str, Tamper] = {
    "honest": honest,
    "3 invented": invent(3),
    "10 invented": invent(10),
    "20 invented": invent(20),
    "half removed": remove(0.5),
    "80 % removed": remove(0.8),
    "half shifted by 4 m": shift(0.5),
    "replayed, 2 s old": replay,
}


def draw(path: Path) -> None:
    """Evidence over time in one simulated scene."""
    from cobevglue.misbehaviour import MisbehaviourConfig
    from cobevglue.visualization.style import (
        EGO,
        GIVEN_POSE,
        OTHER,
        TRUTH,
        add_axes,
        legend_below,
        light_grid,
        new_figure,
        same_scale,
        save_figure,
        set_title,
        style_bev,
    )

    drive = scene_sequence("motorway", 2, delay=0.1).frames
    figure = new_figure(10.0, 4.6)
    scene, lines = add_axes(figure, 1, 2)
    frame, tampered = drive[60], ATTACKS["10 invented"](drive, 60, np.random.default_rng([0, 84, 0]))
    pose = frame.ego_SE2_other
    ids = tampered.track_id
    assert ids is not None
    false = tampered[ids >= 10**6].transform(pose)
    style_bev(scene, "Seen by the ego; reported by the other")
    for boxes, colour, fill, label in (
        (frame.ego, EGO, True, "ego"),
        (frame.other.transform(pose), OTHER, False, "other"),
        (false, GIVEN_POSE, False, "other, invented"),
    ):
        near = boxes[np.hypot(boxes.center[:, 0], boxes.center[:, 1]) < 60.0]
        for k, corners in enumerate(near.bev_corners()):
            x, y = np.vstack([corners, corners[:1]]).T
            scene.fill(x, y, facecolor=colour if fill else "none", edgecolor=colour, label=None if k else label)
    scene.set_xlim(-60.0, 60.0)
    scene.set_ylim(-60.0, 60.0)
    same_scale([scene])
    for name, colour in (("honest", TRUTH), ("10 invented", GIVEN_POSE), ("half removed", OTHER)):
        reports = [report for report, _ in run(drive, ATTACKS[name], 0)]
        lines.plot(
            0.1 * np.arange(len(reports)), [max(r.invented, r.removed) for r in reports], color=colour, label=name
        )
    lines.axhline(MisbehaviourConfig().evidence, color="#444444", linewidth=0.8, label="reported from here on")
    lines.axvline(0.1 * START, color="#444444", linestyle=":")
    set_title(lines, "Evidence, tampered with from 3 s on")
    lines.set(xlabel="time [s]", ylabel="log-likelihood ratio [nats]")
    light_grid(lines)
    legend_below(figure, 4)
    save_figure(figure, path)


if __name__ == "__main__":
    main()
