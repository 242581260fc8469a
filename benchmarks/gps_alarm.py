"""How fast `LocalisationMonitor` finds false claims of a pose, and how often it raises the alarm over honest ones.

    python benchmarks/gps_alarm.py                           # everything below, on the development data
    python benchmarks/gps_alarm.py --data confirmation       # the same on the data kept apart
    python benchmarks/gps_alarm.py --only honest --hours 24  # false alarms
    python benchmarks/gps_alarm.py --only attacks            # delay to alarm, by attack
    python benchmarks/gps_alarm.py --only agents             # three agents: whose claim is false
    python benchmarks/gps_alarm.py --json results.json
    python benchmarks/gps_alarm.py --picture docs/images/gps_alarm.png    # only the picture of docs/trust.md

Alignments are measured ones: BEVGlue on V2V4Real (own frames, own vehicles given; development: train, confirmation:
val) and on simulated scenes with lists 0.1 s late (development: seeds
0 to 15, confirmation: 100 to 115). Long drives are put together from them: blocks of up to 5 s, drawn at random with
half of them from each source, with their errors, covariances and refusals as they were. Where no alignment is
usable, nothing can be found; "aligned": usable in 8 of the first 10 frames of the attack. Localisation is simulated:
claims are the truth plus a first-order Gauss-Markov process for each agent and component (time constant 60 s). The ego
drives at 10 m/s. The data is read from $COBEVGLUE_DATA (default ../shared/data).
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.signal import lfilter

from alignment import show
from cobevglue import SE2, BEVGlue
from cobevglue.alignment import Alignment
from cobevglue.alignment.own_body import known_bodies
from cobevglue.datasets.poses import SE3_from_SE2
from cobevglue.disturbance import (
    Disturbance,
    LocalisationNoise,
    ObservedFrame,
    OffsetPose,
    ReplayedPose,
    SamePlace,
)
from cobevglue.evaluation.alignment import AlignmentSequence
from cobevglue.evaluation.alignment_data import V2V4REAL_TRAIN, V2V4REAL_VAL, v2v4real_car_sequences
from cobevglue.evaluation.scene_data import scene_sequence
from cobevglue.localisation_monitor import LocalisationMonitor, LocalisationMonitorConfig
from cobevglue.simulation import Junction, JunctionSettings
from cobevglue.simulation.object_scenes import SCENES
from cobevglue.tracking import Sort
from cobevglue.typing import FloatArray
from common import DATA, print_head

SCENE_SEEDS = {"development": range(16), "confirmation": range(100, 116)}
SEQUENCES = {"development": V2V4REAL_TRAIN, "confirmation": V2V4REAL_VAL}
SEED = {"development": 0, "confirmation": 1}
FRAME, BLOCK, SPEED = 0.1, 50, 10.0
TIME_CONSTANT = 60.0
TRIALS, BEFORE = 200, 100
"""Attacks of each kind, and honest frames before each."""
POSITION_STDS = (0.5, 1.0)
YAW_STD = math.radians(0.5)
AGENT_SEEDS = {"development": range(8), "confirmation": range(100, 108)}

Table = list[dict[str, Any]]


class Aligned(NamedTuple):
    """One frame: the true ego_SE2_other, and what BEVGlue said."""

    truth: SE2
    alignment: Alignment


class Drift(OffsetPose):
    """Claims that move away at a constant speed, from the first frame of `frames` on.

    Attributes:
        speed: of the claim relative to the agent [m/s]; x, y and yaw are the offset after one second.
    """

    start: int

    def apply(self, frames: Sequence[ObservedFrame], index: int, ego: str, key: Sequence[int]) -> ObservedFrame:
        """Collaborators claim a pose farther and farther off."""
        seconds = FRAME * (index - self.start + 1)
        now = OffsetPose(x=self.x * seconds, y=self.y * seconds, yaw=self.yaw * seconds)
        return now.apply(frames, index, ego, key)


ATTACKS: dict[str, tuple[Disturbance, int]] = {
    "jump by 5 m": (OffsetPose(x=3.0, y=4.0, yaw=0.0), 100),
    "jump by 3 m": (OffsetPose(x=1.8, y=2.4, yaw=0.0), 100),
    "offset of OffsetPose: 3 m, -2 m, 3 degrees": (OffsetPose(), 100),
    "SamePlace": (SamePlace(), 100),
    "ReplayedPose, 1 s": (ReplayedPose(), 100),
    "drift of 0.1 m/s": (Drift(x=0.06, y=0.08, yaw=0.0, start=BEFORE), 600),
    "drift of 0.5 m/s": (Drift(x=0.3, y=0.4, yaw=0.0, start=BEFORE), 300),
    "no attack; LocalisationNoise (white, 0.5 m, 0.5 degrees)": (LocalisationNoise(), 300),
}
"""The attack, and how many frames it lasts."""


def main() -> None:
    """Print the tables and, on request, write them as JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=("honest", "attacks", "agents"))
    parser.add_argument("--data", choices=tuple(SEED), default="development")
    parser.add_argument("--hours", type=float, default=24.0)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--picture", type=Path)
    arguments = parser.parse_args()
    which, only = arguments.data, arguments.only
    if arguments.picture:
        draw(arguments.picture)
        return
    print_head(f"{which} data, seed {SEED[which]}")
    tables: dict[str, Table] = {}
    if only != "agents":
        measured = sources(DATA, which)
        if only in (None, "attacks"):
            tables["attacks"] = attacks(measured, SEED[which])
        if only in (None, "honest"):
            tables["honest"] = honest(measured, SEED[which], arguments.hours)
    if only in (None, "agents"):
        tables["agents"] = agents(AGENT_SEEDS[which])
    if arguments.json:
        arguments.json.write_text(json.dumps(tables, indent=1))


def sources(data: Path, which: str) -> list[list[list[Aligned]]]:
    """Sequences of measured alignments: of V2V4Real, and of the simulated scenes."""
    real = v2v4real_car_sequences(
        data / "v2v4real_detections", data / "v2v4real_cars.csv", SEQUENCES[which], bodies=True
    )
    scenes = (scene_sequence(name, seed, delay=0.1) for name in SCENES for seed in SCENE_SEEDS[which])
    found: list[list[list[Aligned]]] = []
    for sequences in (real, scenes):
        found.append([])
        for sequence in sequences:
            rows = align(sequence)
            if len(rows) > BLOCK:
                found[-1].append(rows)
    accepted = [row.alignment.accepted for source in found for rows in source for row in rows]
    print(f"{len(accepted)} measured alignments, {100.0 * np.mean(accepted):.1f} % accepted", file=sys.stderr)
    return found


def align(sequence: AlignmentSequence) -> list[Aligned]:
    """BEVGlue on a sequence."""
    glue, rows = BEVGlue(), []
    for frame in sequence.frames:
        bodies = known_bodies(frame.ego_body, frame.other_body)
        rows.append(Aligned(frame.ego_SE2_other, glue.align(frame.ego, frame.other, frame.time, **bodies)))
    return rows


def blocks(measured: list[list[list[Aligned]]], rng: np.random.Generator) -> Iterator[Aligned]:
    """Frames without end: 5 s of a random sequence, then of another."""
    while True:
        source = measured[rng.integers(len(measured))]
        lengths = np.array([len(rows) for rows in source], dtype=float)
        rows = source[rng.choice(len(source), p=lengths / lengths.sum())]
        start = int(rng.integers(0, len(rows) - BLOCK + 1))
        yield from rows[start : start + BLOCK]


def gauss_markov(frames: int, spread: FloatArray, rng: np.random.Generator) -> FloatArray:
    """(frames, K) stationary first-order Gauss-Markov processes of these standard deviations (K,)."""
    kept = math.exp(-FRAME / TIME_CONSTANT)
    new = rng.standard_normal((frames, len(spread)))
    new[1:] *= math.sqrt(1.0 - kept**2)
    noise: FloatArray = lfilter([1.0], [1.0, -kept], new, axis=0) * spread
    return noise


def claims(
    aligned: Sequence[Aligned], start: int, errors: FloatArray
) -> Iterator[tuple[float, dict[str, SE2], dict[str, SE2]]]:
    """Times, claimed and true world_SE2_agent of the ego and the other.

    Args:
        aligned: the frames.
        start: number of the first.
        errors: (frames, 6) of the ego's and the other's x, y [m], yaw [rad].
    """
    heading = 0.3
    for i, (frame, error) in enumerate(zip(aligned, errors, strict=True)):
        along = SPEED * FRAME * (start + i) % 1000.0
        ego = SE2(along * math.cos(heading), along * math.sin(heading), heading)
        true = {"ego": ego, "other": ego @ frame.truth}
        claimed = {
            name: SE2(pose.x + e[0], pose.y + e[1], pose.yaw + e[2])
            for (name, pose), e in zip(true.items(), (error[:3], error[3:]), strict=True)
        }
        yield FRAME * (start + i), claimed, true


def honest(measured: list[list[list[Aligned]]], seed: int, hours: float) -> Table:
    """False alarms, and how near to an alarm the tests came."""
    print(f"## Honest claims, {hours:g} h of frames at 10 Hz\n")
    table: Table = []
    for number, position in enumerate(POSITION_STDS):
        spread = np.array([position, position, YAW_STD])
        covariance = np.diag(spread**2)
        rng = np.random.default_rng([seed, 80, number])
        frames = round(hours * 3600.0 / FRAME)
        errors = gauss_markov(frames, np.tile(spread, 2), rng)
        drive = blocks(measured, rng)
        monitor = LocalisationMonitor()
        alarms, raised, reasons = 0, False, []
        highest = {"jump": 0.0, "deviations": 0.0}
        for start in range(0, frames, 1000):
            part = errors[start : start + 1000]
            rows = list(itertools.islice(drive, len(part)))
            for (time, claimed, _), row in zip(claims(rows, start, part), rows, strict=True):
                report = monitor.update(
                    time, {name: (pose, covariance) for name, pose in claimed.items()}, {"other": row.alignment}, "ego"
                )
                for test in report.pairs.values():
                    highest["jump"] = max(highest["jump"], test.jump)
                    highest["deviations"] = max(highest["deviations"], test.deviations)
                    if test.reason and not raised:
                        reasons.append(test.reason)
                alarms += report.alarm and not raised
                raised = report.alarm
        table.append(
            {
                "claimed std [m]": position,
                "frames": frames,
                "false alarms": alarms,
                "of them offset": sum("offset" in reason for reason in reasons),
                "highest jump statistic": highest["jump"],
                "highest deviations": highest["deviations"],
            }
        )
        print("   …", table[-1], file=sys.stderr)
    show(table)
    return table


def attacks(measured: list[list[list[Aligned]]], seed: int) -> Table:
    """Delay to alarm."""
    print(f"## Attacks, {TRIALS} of each after {BEFORE} honest frames\n")
    table: Table = []
    for position, (name, (attack, last)) in itertools.product(POSITION_STDS, ATTACKS.items()):
        spread = np.array([position, position, YAW_STD])
        delays, seen, before, monitor = [], [], 0, LocalisationMonitor()
        for trial in range(TRIALS):
            rng = np.random.default_rng([seed, 81, trial])
            rows = list(itertools.islice(blocks(measured, rng), BEFORE + last))
            errors = gauss_markov(len(rows), np.tile(spread, 2), rng)
            found = first_alarm(rows, errors, np.diag(spread**2), attack, [seed, trial])
            if found is not None and found < BEFORE:
                before += 1
            else:
                delays.append(math.inf if found is None else FRAME * (found - BEFORE + 1))
                seen.append(sum(monitor.uses(row.alignment) for row in rows[BEFORE : BEFORE + 10]) >= 8)
        delay, aligned = np.array(delays), np.array(seen)
        table.append(
            {
                "claimed std [m]": position,
                "attack": name,
                "lasts [s]": FRAME * last,
                "found within 1 s": float((delay <= 1.0 + 1e-9).mean()),
                "the same, aligned": float((delay[aligned] <= 1.0 + 1e-9).mean()),
                "found": float(np.isfinite(delay).mean()),
                "median delay [s]": float(np.median(delay)),
                "within 50 s": float((delay <= 50.0 + 1e-9).mean()),
                "alarm before": before,
            }
        )
        print("   …", table[-1], file=sys.stderr)
    show(table)
    return table


def first_alarm(
    rows: Sequence[Aligned], errors: FloatArray, covariance: FloatArray, attack: Disturbance, key: list[int]
) -> int | None:
    """Number of the first frame with an alarm; the attack begins with frame `BEFORE`."""
    monitor = LocalisationMonitor()
    frames = [
        ObservedFrame(
            time,
            dict.fromkeys(claimed),  # type: ignore[arg-type]  # attacks on localisation look at no observation
            {name: SE3_from_SE2(pose) for name, pose in claimed.items()},
            {name: SE3_from_SE2(pose) for name, pose in true.items()},
        )
        for time, claimed, true in claims(rows, 0, errors)
    ]
    for index, row in enumerate(rows):
        frame = frames[index] if index < BEFORE else attack.apply(frames, index, "ego", key)
        poses = {name: (SE2.from_matrix(pose), covariance) for name, pose in frame.claimed.items()}
        if monitor.update(frame.time, poses, {"other": row.alignment}, "ego").alarm:
            return index
    return None


def agents(seeds: range) -> Table:
    """Three agents of a simulated junction, one of whose claims jumps: who is said to be at fault?"""
    print("## Three agents at a simulated junction, 16 s; one claim jumps by 5 m after 8 s (std 0.5 m)\n")
    table: Table = []
    for liar in ("nobody", "car1", "car2", "car3"):
        count = dict.fromkeys(("alarm before", "alarm within 1 s", "alarm", "right agent", "wrong agent"), 0)
        for seed in seeds:
            faulty, delay = junction(seed, liar)
            count["alarm before"] += delay is not None and delay < 0.0
            count["alarm within 1 s"] += delay is not None and 0.0 <= delay <= 1.0
            count["alarm"] += delay is not None and delay >= 0.0
            count["right agent"] += faulty == {liar}
            count["wrong agent"] += bool(faulty - {liar})
        table.append({"false claim": liar + (" (the ego)" if liar == "car1" else ""), "drives": len(seeds), **count})
    show(table)
    return table


def junction(seed: int, liar: str) -> tuple[set[str], float | None]:
    """Agents said to be at fault at the end, and the time from the jump to the alarm [s]."""
    scene = Junction(seed, JunctionSettings(agents=3, duration=16.0))
    names = ["car1", "car2", "car3"]
    trackers, glues = {name: Sort() for name in names}, {name: BEVGlue() for name in names[1:]}
    spread = np.array([0.5, 0.5, YAW_STD])
    errors = gauss_markov(len(scene), np.tile(spread, 3), np.random.default_rng([seed, 82])).reshape(-1, 3, 3)
    monitor, delay, faulty = LocalisationMonitor(), None, set()
    for frame in scene:
        boxes = {name: trackers[name].update(frame.agents[name].boxes, frame.time) for name in names}
        claimed = {}
        for name, error in zip(names, errors[frame.index], strict=True):
            pose = frame.agents[name].world_SE2_agent
            off = (3.0, 4.0) if name == liar and frame.time >= 8.0 else (0.0, 0.0)
            claimed[name] = SE2(pose.x + error[0] + off[0], pose.y + error[1] + off[1], pose.yaw + error[2])
        own = frame.agents["car1"].body
        found = {
            name: glue.align(boxes["car1"], boxes[name], frame.time, ego_body=own, other_body=frame.agents[name].body)
            for name, glue in glues.items()
        }
        report = monitor.update(
            frame.time, {name: (pose, np.diag(spread**2)) for name, pose in claimed.items()}, found, "car1"
        )
        if report.alarm and delay is None:
            delay = frame.time - 8.0
        faulty = set(report.faulty)
    return faulty, delay


def draw(path: Path) -> None:
    """Statistics of three drives over time, with alignments of simulated motorways: honest, a jump, a drift."""
    measured = [[align(scene_sequence("motorway", seed, delay=0.1)) for seed in range(4)]]
    from cobevglue.visualization.style import (
        GIVEN_POSE,
        MATCH,
        OTHER,
        add_axes,
        legend_below,
        light_grid,
        new_figure,
        save_figure,
        set_title,
    )

    figure = new_figure(9.5, 5.2)
    plots = add_axes(figure, 2, 3)
    kinds: list[tuple[str, Callable[[float], float]]] = [
        ("Honest", lambda t: 0.0),
        ("Jump by 5 m at 30 s", lambda t: 5.0 * (t >= 30.0)),
        ("Drift of 0.1 m/s from 30 s", lambda t: 0.1 * max(t - 30.0, 0.0)),
    ]
    spread = np.array([0.5, 0.5, YAW_STD])
    config = LocalisationMonitorConfig()
    for column, (title, false) in enumerate(kinds):
        rng = np.random.default_rng([0, 83])
        rows = list(itertools.islice(blocks(measured, rng), 900))
        errors = gauss_markov(len(rows), np.tile(spread, 2), rng)
        monitor, lines, alarms = LocalisationMonitor(), [], []
        for (time, claimed, true), row in zip(claims(rows, 0, errors), rows, strict=True):
            other = claimed["other"]
            claimed["other"] = SE2(other.x + false(time), other.y, other.yaw)
            poses: Mapping[str, tuple[SE2, FloatArray]] = {n: (p, np.diag(spread**2)) for n, p in claimed.items()}
            report = monitor.update(time, poses, {"other": row.alignment}, "ego")
            gap = claimed["other"].translation - claimed["ego"].translation
            gap -= true["other"].translation - true["ego"].translation
            for test in report.pairs.values():
                lines.append((time, math.hypot(*gap), math.hypot(*test.offset), test.jump, test.deviations))
                alarms += [time] if report.alarm else []
        t, error, offset, jump, deviations = np.array(lines).T
        above, below = plots[column], plots[3 + column]
        above.plot(t, error, color=GIVEN_POSE, label="error of the claim")
        above.plot(t, offset, color=MATCH, label="by the filter")
        below.plot(t, jump, color=OTHER, label="jump: CUSUM / threshold")
        below.plot(t, deviations / config.offset, color=MATCH, linestyle="--", label="offset / threshold")
        below.axhline(1.0, color="#444444", linewidth=0.8)
        for axes in (above, below):
            if alarms:
                axes.axvline(alarms[0], color="#444444", linestyle=":", label="alarm")
            light_grid(axes)
            axes.set_xlim(0.0, 90.0)
        above.set_ylim(0.0, 7.0)
        below.set_ylim(0.0, 2.2)
        set_title(above, title, 11.0)
        below.set_xlabel("time [s]")
    plots[0].set_ylabel("metres")
    plots[3].set_ylabel("test statistic")
    legend_below(figure, 5)
    save_figure(figure, path)


if __name__ == "__main__":
    main()
