"""Height, roll and pitch of another agent from matched objects: `python benchmarks/levelling.py`.

- objects: errors over the number of matched objects, one frame; random tilts, detection errors of 0.1 m.
- mast: simulated mast scenes whose mast is pitched: planar position of its foot as aligned, corrected by the levelling,
  and where the boxes are levelled by what the filter knows and then aligned.
- v2v4real: spread of the heights of centres and of bottoms, about a plane, in recorded detections of two cars.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable

import numpy as np
from scipy.optimize import linear_sum_assignment
from scipy.spatial.transform import Rotation

from cobevglue import SE2, Alignment, BEVGlue, Boxes
from cobevglue.alignment import LevellingConfig, LevellingFilter, estimate_levelling
from cobevglue.datasets.poses import inverse_SE3, transform_boxes
from cobevglue.datasets.tracking_text import read_v2v4real_detections
from cobevglue.evaluation.scene_data import scene_of, scene_sequence
from cobevglue.simulation.object_scenes import Mast
from cobevglue.simulation.scripted_traffic import LIDAR_HEIGHT
from cobevglue.typing import FloatArray
from common import DATA, print_head

_STD = 0.1  # of each coordinate of a detection [m]


def level_SE3_other(z: float, roll: float, pitch: float) -> FloatArray:
    """(4, 4) of the true tilt."""
    matrix = np.eye(4)
    matrix[:3, :3] = Rotation.from_euler("xyz", [roll, pitch, 0.0]).as_matrix()
    matrix[2, 3] = z
    return matrix


def objects(seed: int) -> None:
    """Errors of z, roll and pitch over the number of objects."""
    print("| objects | z: RMS error [m] | roll [°] | pitch [°] | mean NEES (3) | roll, pitch observable |")
    print("|---|---|---|---|---|---|")
    for n in (1, 2, 3, 4, 6, 8, 12, 20):
        errors, nees, observable = [], [], []
        for index in range(500):
            rng = np.random.default_rng([seed, n, index])
            truth = rng.normal(0.0, (2.0, math.radians(4.0), math.radians(4.0)))
            center = np.column_stack([rng.uniform((-5.0, -15.0), (40.0, 15.0), (n, 2)), rng.normal(-1.1, 0.1, n)])
            cars = Boxes(center, np.tile((4.5, 1.9, 1.6), (n, 1)), rng.uniform(-math.pi, math.pi, n))
            x, y = rng.uniform(-20.0, 20.0, 2)
            pose = SE2(x, y, rng.uniform(-math.pi, math.pi))
            ego, other = cars.transform(pose), transform_boxes(cars, inverse_SE3(level_SE3_other(*truth)))
            ego, other = (b.replace(center=b.center + rng.normal(0.0, _STD, (n, 3))) for b in (ego, other))
            matched = Alignment(pose, np.column_stack([np.arange(n), np.arange(n)]))
            found = estimate_levelling(ego, other, matched, LevellingConfig(height_std=_STD * math.sqrt(2.0)))
            error = np.array([found.z, found.roll, found.pitch]) - truth
            errors.append(error)
            nees.append(error @ np.linalg.solve(found.covariance, error))
            observable.append(found.observable[1:])
        z, roll, pitch = np.sqrt(np.mean(np.square(errors), axis=0))
        share = " / ".join(f"{s:.0%}" for s in np.mean(observable, axis=0))
        tilt = f"{math.degrees(roll):.2f} | {math.degrees(pitch):.2f}"
        print(f"| {n} | {z:.2f} | {tilt} | {np.mean(nees):.2f} | {share} |")


def mast(seed: int, scenes: int = 6) -> None:
    """Planar errors with a pitched mast as the other agent."""
    print("| pitch of the mast [°] | aligned as | accepted | planar error as aligned: median, 90 % [m] ", end="")
    print("| corrected [m] | heights of the boxes, last 2 s: RMS error [m] | z, last frame [m] | pitch [°] |")
    print("|---|---|---|---|---|---|---|---|")
    seeds = [s for s in range(seed, seed + 100) if isinstance(list(scene_of("mast", s).agents.values())[1], Mast)]
    sequences = [(s, scene_sequence("mast", s, duration=4.0)) for s in seeds[:scenes]]
    for degrees in (0.0, 5.0, 10.0, 15.0, 20.0):
        for again in (False, True):
            planar, corrected, heights, errors, pitches, frames = [], [], [], [], [], 0
            for s, sequence in sequences:
                carrier = list(scene_of("mast", s).agents.values())[1]
                assert isinstance(carrier, Mast)
                z = carrier.height - LIDAR_HEIGHT
                mast_SE3_other = level_SE3_other(0.0, 0.0, math.radians(degrees))  # frame.other is at the mast's height
                glue, levelling = BEVGlue(), LevellingFilter()
                for number, frame in enumerate(sequence.frames):
                    other = transform_boxes(frame.other, inverse_SE3(mast_SE3_other))
                    known = levelling.levelling
                    aligned = known.level(other) if again else other
                    alignment = glue.align(frame.ego, aligned, time=frame.time, ego_body=frame.ego_body)
                    frames += 1
                    found = levelling.update(frame.ego, other, alignment)
                    if alignment.ego_SE2_other is None or frame.ego_SE2_other is None:
                        continue
                    # Levelled boxes: the pose is that of the level frame already.
                    pose = alignment.ego_SE2_other if again else found.ego_SE2_level(alignment, other)
                    planar.append(alignment.ego_SE2_other.error_to(frame.ego_SE2_other)[0])
                    corrected.append(pose.error_to(frame.ego_SE2_other)[0])
                    if number >= 20:
                        gap = found.level(other).center[:, 2] - frame.other.center[:, 2] - z
                        heights.append(float(np.sqrt((gap**2).mean())))
                errors.append(levelling.levelling.z - z)
                pitches.append(math.degrees(levelling.levelling.pitch) - degrees)
            row = [f"{degrees:.0f}", "levelled" if again else "they are", f"{len(planar) / frames:.1%}"]
            row += [f"{np.median(planar):.2f}, {np.quantile(planar, 0.9):.2f}"] if planar else ["-"]
            row += [f"{np.median(corrected):.2f}, {np.quantile(corrected, 0.9):.2f}"] if planar else ["-"]
            row += [f"{_rms(heights):.2f}", f"{_rms(errors):.2f}", f"{_rms(pitches):.2f}"]
            print(f"| {' | '.join(row)} |")


def v2v4real(_: int) -> None:
    """Spread of the differences between two cars' heights of one object, about the plane that fits them best."""
    if not (DATA / "v2v4real_detections").exists():
        print(f"no {DATA / 'v2v4real_detections'}: left out")
        return
    print("| sequences | pairs | centres: std about a plane [m] | bottoms [m] | slope along x, mean ± std [°] |")
    print("|---|---|---|---|---|")
    for split in ("train", "val"):
        residuals: dict[str, list[float]] = {"centres": [], "bottoms": []}
        slopes = []
        for path in sorted((DATA / "v2v4real_detections" / split / "ego").glob("*.txt")):
            theirs = read_v2v4real_detections(path.parents[1] / "other" / path.name)
            for ego, other in list(zip(read_v2v4real_detections(path), theirs, strict=False))[::5]:
                gap = np.linalg.norm(ego.center[:, None, :2] - other.center[None, :, :2], axis=-1)
                i, j = linear_sum_assignment(np.minimum(gap, 5.0))
                near = gap[i, j] < 1.2
                i, j = i[near], j[near]
                if len(i) < 6:
                    continue
                plane = np.column_stack([np.ones(len(i)), other.center[j, :2]])
                centre = ego.center[i, 2] - other.center[j, 2]
                bottom = centre - (ego.size[i, 2] - other.size[j, 2]) / 2.0
                for name, values in (("centres", centre), ("bottoms", bottom)):
                    fit = np.linalg.lstsq(plane, values, rcond=None)[0]
                    residuals[name] += list((values - plane @ fit) * math.sqrt(len(i) / (len(i) - 3)))
                    if name == "centres":
                        slopes.append(math.degrees(fit[1]))
        spread = " | ".join(f"{np.std(values):.3f}" for values in residuals.values())
        slope = f"{np.mean(slopes):.2f} ± {np.std(slopes):.2f}"
        print(f"| V2V4Real {split} | {len(residuals['centres'])} | {spread} | {slope} |")


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else math.nan


PARTS: dict[str, Callable[[int], None]] = {"objects": objects, "mast": mast, "v2v4real": v2v4real}


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--only", choices=PARTS)
    options = parser.parse_args()
    print_head(f"seed {options.seed}")
    for name, part in PARTS.items():
        if options.only in (None, name):
            print(f"### {name}\n")
            part(options.seed)
            print()


if __name__ == "__main__":
    main()
