"""Evaluate the shipped detector on unseen clouds, and BEVGlue on its detections.

    python benchmarks/perception.py                    # everything below, about 10 minutes on two cores
    python benchmarks/perception.py --only real        # OPV2V clouds: average precision, headings, what is missed
    python benchmarks/perception.py --only simulated   # the simulated test split
    python benchmarks/perception.py --only headings    # front and back, by the head, by heading refinement, by tracks
    python benchmarks/perception.py --only alignment   # BEVGlue on the detections of two real OPV2V agents
    python benchmarks/perception.py --only speed       # each stage, and memory
    python benchmarks/perception.py --weights runs/compact/last.safetensors

OPV2V clouds are read from $COBEVGLUE_DATA (default ../shared/data): both agents of TwoCars_1, each in its own frame,
against the objects that its own label file lists, within x +-70 m and y +-39 m. Nothing was trained or chosen on them.
Thresholds of detection were chosen on the simulated validation split.
"""

from __future__ import annotations

import argparse
import copy
import resource
import time
from collections import Counter
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from cobevglue import BEVGlue
from cobevglue.datasets import OPV2V
from cobevglue.evaluation.alignment import AlignmentSequence, evaluate, summarise
from cobevglue.evaluation.alignment_data import perceived_sequences
from cobevglue.evaluation.detection import DetectionReport, evaluate_detections
from cobevglue.evaluation.detection_data import dataset_clouds, detect, simulated_clouds
from cobevglue.evaluation.detection_matching import DetectionFrame, find_failures
from cobevglue.perception import Perception, PointPillars
from cobevglue.simulation.episodes import SimulatedEpisodes
from cobevglue.simulation.scenario import ScenarioSettings, simulated_scenarios
from common import DATA, print_head

PARTS = ("real", "simulated", "headings", "alignment", "speed")
SCENARIO = "TwoCars_1"
RANGE = (-70.0, 70.0, -39.0, 39.0)
TEST_CLOUDS = 400
MIN_POINTS = 5
DRIVES, DRIVE = 8, ScenarioSettings(frames=20, rate=10.0, agents=2)
"""Simulated drives whose headings are counted."""


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--only", choices=PARTS)
    parser.add_argument("--weights", default="compact", help="a shipped name, or a .safetensors file")
    parser.add_argument("--clouds", type=int, default=TEST_CLOUDS, help="simulated clouds")
    parser.add_argument("--split", default="test", help="of the simulated world")
    arguments = parser.parse_args()
    data = DATA / "opv2v"
    print_head(f"weights {arguments.weights}")
    detector = PointPillars.named(arguments.weights)
    wanted = (arguments.only,) if arguments.only else PARTS
    if "real" in wanted:
        real(detector, data)
    if "simulated" in wanted:
        simulated(detector, arguments.split, arguments.clouds)
    if "headings" in wanted:
        headings(detector, data, arguments.split)
    if "alignment" in wanted:
        alignment(detector, data)
    if "speed" in wanted:
        speed(detector, data)


def real(detector: PointPillars, data: Path) -> None:
    """Average precision on OPV2V's clouds, and which objects are missed."""
    clouds = [cloud for cloud in dataset_clouds([OPV2V(data, "test_culvercity")[SCENARIO]]) if cloud.points is not None]
    frames = [detect(cloud, detector) for cloud in clouds]
    show(f"OPV2V {SCENARIO}, {len(frames)} clouds, range {RANGE}", evaluate_detections(frames, evaluation_range=RANGE))
    failures = [f for frame in frames for f in find_failures(frame, threshold=0.7, evaluation_range=RANGE)]
    print("\n| failure at IoU 0.7 | points on it | count |\n|---|---|---|")
    kinds = Counter((failure.kind, points_bin(failure.points or 0)) for failure in failures)
    for (kind, points), count in sorted(kinds.items()):
        print(f"| {kind} | {points} | {count} |")


def points_bin(points: int) -> str:
    """Which row of the table."""
    return "0-9" if points < 10 else "10-49" if points < 50 else "50-"


def simulated(detector: PointPillars, split: str, count: int) -> None:
    """Average precision on networks and traffic that the training never saw."""
    frames = (detect(cloud, detector) for cloud in simulated_clouds(SimulatedEpisodes(split), count))
    report = evaluate_detections(frames, evaluation_range=RANGE, min_points=MIN_POINTS)
    show(f"Simulated {split} split, {count} clouds, objects with >= {MIN_POINTS} points, range {RANGE}", report)


def show(title: str, report: DetectionReport) -> None:
    """One table."""
    print(f"\n## {title}\n\n| objects | AP 0.3 | AP 0.5 | AP 0.7 | frame order 0.5 | 0.7 |\n|---|---|---|---|---|---|")
    for name, part in {"all": report.overall, **report.by_range}.items():
        cells = [part.at[t].ap["global"] for t in (0.3, 0.5, 0.7)] + [part.at[t].ap["frame-order"] for t in (0.5, 0.7)]
        print(f"| {name}: {part.truth} | " + " | ".join(f"{cell:.3f}" for cell in cells) + " |")
    print("\n" + "; ".join(f"{name} {value:.3f}" for name, value in vars_of(report.errors).items()))


def vars_of(errors: object) -> dict[str, float]:
    """The fields of a dataclass with slots."""
    return {name: float(getattr(errors, name)) for name in getattr(errors, "__dataclass_fields__", {})}


def headings(detector: PointPillars, data: Path, split: str) -> None:
    """Which share of true positives (IoU 0.5, score >= 0.3) is the wrong way round, in drives at 10 Hz."""
    print(
        "\n## Headings\n\n| clouds | true positives | head alone | heading refinement | and tracked | head, tracked |"
    )
    print("|---|---|---|---|---|---|")
    once = copy.deepcopy(detector)
    once.detection = detector.detection.model_copy(update={"heading_refinement": False})
    drives = {
        f"OPV2V {SCENARIO}": [OPV2V(data, "test_culvercity")[SCENARIO]],
        f"simulated {split} split, {DRIVES} drives": simulated_scenarios(split, DRIVES, settings=DRIVE),
    }
    for name, scenarios in drives.items():
        seen: dict[str, list[DetectionFrame]] = {"once": [], "twice": [], "twice, tracked": [], "once, tracked": []}
        for scenario in scenarios:
            perceivers: dict[tuple[str, str], Perception] = {}
            for cloud in dataset_clouds([scenario]):
                if cloud.points is None:
                    continue
                for look, one in (("once", once), ("twice", detector)):
                    alone = detect(cloud, one)
                    tracked = perceivers.setdefault((cloud.agent, look), Perception(one)).step(cloud.points).boxes
                    seen[look].append(alone)
                    seen[f"{look}, tracked"].append(replace(alone, detections=tracked, detection_point_count=None))
        errors = [evaluate_detections(f, evaluation_range=RANGE, min_points=1).errors for f in seen.values()]
        cells = [name, str(errors[1].count), *(f"{one.flipped:.1%}" for one in errors)]
        print("| " + " | ".join(cells) + " |", flush=True)


def alignment(detector: PointPillars, data: Path) -> None:
    """BEVGlue on detections: each frame on its own, and over time."""
    print(f"\n## BEVGlue on detections of the two agents of {SCENARIO}\n")
    scenarios = [OPV2V(data, "test_culvercity")[SCENARIO]]
    (sequence,) = perceived_sequences(scenarios, lambda: Perception(detector))
    print("| | frames | accepted | wrong (>= 3 m) | median error [m] | [deg] | largest [m] | co-visible |")
    print("|---|---|---|---|---|---|---|---|")
    alone = [
        record for frame in sequence.frames for record in evaluate([AlignmentSequence(sequence.name, [frame])], BEVGlue)
    ]
    for name, records in (("over time", list(evaluate([sequence], BEVGlue))), ("single frames", alone)):
        accepted = [record for record in records if record.accepted]
        errors = [record.translation_error for record in accepted] or [float("nan")]
        turns = np.degrees([record.yaw_error for record in accepted] or [float("nan")])
        wrong = sum(not record.right for record in accepted)
        seen = np.median([record.co_visible for record in records])
        print(
            f"| {name} | {len(records)} | {len(accepted)} | {wrong} | {np.median(errors):.2f} | {np.median(turns):.2f} "
            f"| {max(errors):.2f} | {seen:.0f} |"
        )
        print(f"  match precision {summarise(records).match_precision:.3f}")


def speed(detector: PointPillars, data: Path) -> None:
    """Median time of each stage on two threads, and the process's largest memory."""
    torch.set_num_threads(2)
    scenario = OPV2V(data, "test_culvercity")[SCENARIO]
    perception, seconds = Perception(detector), []
    for _ in range(3):
        perception.reset()
        for frame in scenario:
            agent = frame.agents["car1"]
            start = time.perf_counter()
            points = agent.points
            if points is None:
                continue
            loaded = time.perf_counter()
            stages = perception.step(points).seconds
            seconds.append({"load": loaded - start, **stages, "all": time.perf_counter() - start})
    print("\n## Speed, one cloud on two cores\n\n| stage | median [ms] |\n|---|---|")
    for stage in seconds[0]:
        print(f"| {stage} | {1e3 * np.median([one[stage] for one in seconds[2:]]):.1f} |")
    print(f"\nlargest memory {resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024:.0f} MB")


if __name__ == "__main__":
    main()
