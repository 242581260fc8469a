"""Quality and speed of the tracker on real detections: `python benchmarks/tracking.py`.

Three sources, all in the frame of a moving vehicle; the trackers do not receive its motion:

- KITTI tracking (PointRCNN cars, five sequences). A detection's similarity to a label is the BEV IoU of their boxes,
  0.5 for MOTA and IDF1. Only `Car` labels count. Detections on a Van (IoU 0.5), or unmatched and for more than half in
  a DontCare region of the image, are left out after tracking. Labels that are cut off or hidden do count, so these are
  not KITTI's own numbers. The score threshold is the one with the best HOTA on 0001 and 0006; the others confirm.
- V2V4Real (two real cars' PointPillars, all detections). Similarity is 1 - d / 4 m of the centres' distance d, so that
  0.5 is 2 m. The labels hold many cars twice, once per car that drove, under two ids up to 1 m apart and often by
  turns: a floor under switches that no tracker gets below. Train is what the settings were chosen on; its 0000 is
  val's 0000 and left out. "Swerving": the boxes as from a frame that also drives to and fro by 30 m at up to 15 m/s,
  and turns by up to 0.3 rad/s.
- OPV2V Culver City, true boxes with the errors of a detector (`DetectionErrors`): exact identities. Similarity as
  for V2V4Real.

Columns: HOTA, AssA, MOTA, IDF1 in % (trackeval, all sequences together). Per 100 detections matched with a label:
*switches*, an object gets another id than it had; *mix-ups*, an id goes over to another object while the old one is
still there, 2 m or more away: what the object matching can least bear.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Sequence
from functools import cache
from typing import NamedTuple, Protocol

import numpy as np
from scipy.optimize import linear_sum_assignment
from trackeval.metrics import CLEAR, HOTA, Identity

from cobevglue import SE2, Boxes
from cobevglue.datasets import OPV2V
from cobevglue.datasets.tracking_text import (
    count_frames,
    read_kitti_detections,
    read_kitti_labels,
    read_v2v4real_detections,
    read_v2v4real_labels,
)
from cobevglue.disturbance.detection_errors import DetectionErrors, add_detection_errors
from cobevglue.iou import bev_iou
from cobevglue.tracking import Sort, SortConfig
from cobevglue.typing import BoolArray, FloatArray, IntArray
from common import DATA, print_head

KITTI_TUNED, KITTI_CONFIRMED = ("0001", "0006"), ("0008", "0010", "0012")
V2V4REAL = {"train": [f"{k:04d}" for k in range(1, 11)], "val": ["0000", "0001", "0004", "0005", "0008"]}
SAME_OBJECT = 2.0
"""Labels nearer to each other than this [m] may be one car labelled twice."""


class Tracker(Protocol):
    """Interface of the compared trackers."""

    def update(self, boxes: Boxes) -> Boxes:
        """The same boxes with `track_id`."""


class NearestNeighbour:
    """Baseline: greedy matching to the boxes of the previous frame, nearest pairs first, without a motion model."""

    def __init__(self, max_distance: float = 4.0) -> None:
        self.max_distance = max_distance
        self._last = Boxes.empty().replace(track_id=[])
        self._next_id = 0

    def update(self, boxes: Boxes) -> Boxes:
        """The same boxes with `track_id`."""
        assert self._last.track_id is not None
        distance = np.linalg.norm(self._last.center[:, None, :2] - boxes.center[None, :, :2], axis=-1)
        ids = np.full(len(boxes), -1, dtype=np.int64)
        taken: set[int] = set()
        near = np.argwhere(distance < self.max_distance)
        for i, j in near[np.argsort(distance[near[:, 0], near[:, 1]], kind="stable")].tolist():
            if i not in taken and ids[j] < 0:
                ids[j] = self._last.track_id[i]
                taken.add(i)
        new = ids < 0
        ids[new] = np.arange(self._next_id, self._next_id + new.sum())
        self._next_id += int(new.sum())
        self._last = boxes.replace(track_id=ids)
        return self._last


TRACKERS: dict[str, Callable[[], Tracker]] = {
    "nearest neighbour, 4 m": NearestNeighbour,
    "Sort, frame motion off": lambda: Sort(SortConfig(frame_motion=False)),
    "Sort, 0.3 s until a track ends": lambda: Sort(SortConfig(max_age=0.3)),
    "Sort, distance of centres": lambda: Sort(SortConfig(affinity="distance")),
    "**Sort**, as is (GIoU)": Sort,
}


class View(NamedTuple):
    """A frame: what is detected, what is labelled, how alike they are, and which detections count."""

    detected: Boxes
    labels: Boxes
    similarity: FloatArray  # (labels, detected) in [0, 1]
    counts: BoolArray  # (detected,)


def closeness(labels: Boxes, detected: Boxes) -> FloatArray:
    """1 at the same place, 0.5 at 2 m, 0 from 4 m on."""
    distance = np.linalg.norm(labels.center[:, None, :2] - detected.center[None, :, :2], axis=-1)
    similarity: FloatArray = np.clip(1.0 - distance / 4.0, 0.0, 1.0)
    return similarity


def pairs(similarity: FloatArray) -> tuple[IntArray, IntArray]:
    """Rows and columns of the best one-to-one assignment with a similarity of 0.5 or more."""
    rows, columns = linear_sum_assignment(np.where(similarity >= 0.5, similarity, 0.0), maximize=True)
    enough = similarity[rows, columns] >= 0.5
    return rows[enough], columns[enough]


# Sequences


@cache
def kitti(sequence: str, min_score: float) -> list[View]:
    """The frames of a KITTI tracking sequence."""
    folder = DATA / "kitti_tracking"
    detections, labels = folder / "detections" / f"{sequence}.txt", folder / "labels" / f"{sequence}.txt"
    n = count_frames(detections, labels)
    cars, vans = read_kitti_labels(labels, ("car",), n), read_kitti_labels(labels, ("van",), n)
    in_image = np.loadtxt(detections, delimiter=",", usecols=(0, 2, 3, 4, 5))
    lines = [line.split() for line in labels.read_text().splitlines()]
    views = []
    for frame, boxes in enumerate(read_kitti_detections(detections, n)):
        image_boxes = in_image[in_image[:, 0] == frame, 1:]
        regions = np.array([row[6:10] for row in lines if int(row[0]) == frame and row[2] == "DontCare"], dtype=float)
        similarity = bev_iou(cars[frame], boxes)
        matched = np.isin(np.arange(len(boxes)), pairs(similarity)[1])
        on_van = np.isin(np.arange(len(boxes)), pairs(bev_iou(vans[frame], boxes))[1])
        counts = matched | ~(on_van | (covered(image_boxes, regions.reshape(-1, 4)) > 0.5))
        assert boxes.score is not None or not len(boxes)
        keep = np.zeros(0, dtype=bool) if boxes.score is None else boxes.score >= min_score
        views.append(View(boxes[keep], cars[frame], similarity[:, keep], counts[keep]))
    return views


def covered(image_boxes: FloatArray, regions: FloatArray) -> FloatArray:
    """(N,) the largest share of each image box (N, 4) that lies in one of the regions (M, 4)."""
    low = np.maximum(image_boxes[:, None, :2], regions[None, :, :2])
    high = np.minimum(image_boxes[:, None, 2:], regions[None, :, 2:])
    area = np.prod(np.clip(high - low, 0.0, None), axis=-1)
    share: FloatArray = (area / np.prod(image_boxes[:, 2:] - image_boxes[:, :2], axis=1)[:, None]).max(
        axis=1, initial=0
    )
    return share


@cache
def v2v4real(split: str, sequence: str, agent: str, swerving: bool) -> list[View]:
    """The frames of a V2V4Real sequence as one of the two cars saw it."""
    folder = DATA / "v2v4real_detections" / split
    files = folder / agent / f"{sequence}.txt", folder / "labels" / f"{sequence}.txt"
    n = count_frames(*files)
    frames = zip(read_v2v4real_detections(files[0], n), read_v2v4real_labels(files[1], n), strict=True)
    seed = [int(sequence), ["ego", "other"].index(agent)]
    views = []
    for moved_SE2_frame, (boxes, labels) in zip(swerve(n, seed), frames, strict=True):
        if swerving:
            boxes, labels = boxes.transform(moved_SE2_frame), labels.transform(moved_SE2_frame)
        views.append(View(boxes, labels, closeness(labels, boxes), np.ones(len(boxes), dtype=bool)))
    return views


def swerve(n: int, seed: Sequence[int]) -> list[SE2]:
    """A smooth drive at 10 Hz: to and fro by 30 m at up to 15 m/s, to the sides by 5 m, turning by up to 0.3 rad/s."""
    t = 0.1 * np.arange(n)
    phase = np.random.default_rng(seed).uniform(0.0, 2.0 * np.pi, 3)
    x, y = 30.0 * np.sin(0.5 * t + phase[0]), 5.0 * np.sin(0.57 * t + phase[1])
    yaw = 0.48 * np.sin(0.63 * t + phase[2])
    return [SE2(*pose).inverse() for pose in zip(x, y, yaw, strict=True)]


@cache
def opv2v(scenario: str, agent: str, seed: int) -> list[View]:
    """The frames of an OPV2V agent, its true boxes seen by an imperfect detector."""
    views = []
    for index, frame in enumerate(OPV2V(DATA / "opv2v", split="test_culvercity")[scenario]):
        labels = frame.agents[agent].objects
        boxes, _ = add_detection_errors(labels, DetectionErrors(), np.random.default_rng([seed, index]))
        views.append(View(boxes, labels, closeness(labels, boxes), np.ones(len(boxes), dtype=bool)))
    return views


# Scores


def identities(views: Sequence[View], tracker: Tracker) -> list[IntArray]:
    """The track ids that a tracker gives, frame by frame."""
    ids = []
    for view in views:
        tracked = tracker.update(view.detected)
        assert tracked.track_id is not None
        ids.append(tracked.track_id)
    return ids


def id_errors(views: Sequence[View], ids: Sequence[IntArray]) -> IntArray:
    """(3,) matched detections, switches, mix-ups."""
    matched = switches = mixed_up = 0
    id_of: dict[int, int] = {}
    object_of: dict[int, int] = {}
    for view, track_ids in zip(views, ids, strict=True):
        names = [] if view.labels.track_id is None else view.labels.track_id.tolist()
        for row, column in zip(*pairs(view.similarity), strict=True):
            name, track_id = names[row], int(track_ids[column])
            matched += 1
            switches += id_of.get(name, track_id) != track_id
            before = object_of.get(track_id, name)
            if before != name and before in names:
                old, new = view.labels.center[names.index(before), :2], view.detected.center[column, :2]
                mixed_up += bool(np.linalg.norm(old - new) > SAME_OBJECT)
            id_of[name], object_of[track_id] = track_id, name
    return np.array([matched, switches, mixed_up])


def trackeval_input(views: Sequence[View], ids: Sequence[IntArray]) -> dict[str, object]:
    """A sequence in trackeval's form: identities counted from 0, in the order of appearance."""
    label_number: dict[int, int] = {}
    track_number: dict[int, int] = {}
    labels = [
        np.array([label_number.setdefault(k, len(label_number)) for k in view.labels.track_id.tolist()], dtype=int)
        if view.labels.track_id is not None
        else np.zeros(0, dtype=int)
        for view in views
    ]
    tracks = [
        np.array([track_number.setdefault(k, len(track_number)) for k in track_ids[view.counts].tolist()], dtype=int)
        for view, track_ids in zip(views, ids, strict=True)
    ]
    return {
        "gt_ids": labels,
        "tracker_ids": tracks,
        "similarity_scores": [view.similarity[:, view.counts] for view in views],
        "num_gt_dets": sum(map(len, labels)),
        "num_tracker_dets": sum(map(len, tracks)),
        "num_gt_ids": len(label_number),
        "num_tracker_ids": len(track_number),
        "num_timesteps": len(views),
    }


def scores(sequences: Sequence[Sequence[View]], make: Callable[[], Tracker]) -> dict[str, float]:
    """The columns of the tables, over all sequences together."""
    metrics = HOTA(), CLEAR({"PRINT_CONFIG": False}), Identity({"PRINT_CONFIG": False})
    results: list[dict[int, dict[str, float]]] = [{} for _ in metrics]
    errors = np.zeros(3, dtype=np.int64)
    for key, views in enumerate(sequences):
        ids = identities(views, make())
        errors += id_errors(views, ids)
        for metric, result in zip(metrics, results, strict=True):
            result[key] = metric.eval_sequence(trackeval_input(views, ids))
    hota, clear, identity = (m.combine_sequences(r) for m, r in zip(metrics, results, strict=True))
    return {
        "HOTA": 100 * float(np.mean(hota["HOTA"])),
        "AssA": 100 * float(np.mean(hota["AssA"])),
        "MOTA": 100 * float(clear["MOTA"]),
        "IDF1": 100 * float(identity["IDF1"]),
        "switches": 100 * errors[1] / errors[0],
        "mix-ups": 100 * errors[2] / errors[0],
    }


def table(title: str, sequences: Sequence[Sequence[View]]) -> None:
    """Print the scores of all trackers."""
    print(f"\n{title}: {len(sequences)} sequences, {sum(map(len, sequences))} frames\n")
    for number, (name, make) in enumerate(TRACKERS.items()):
        row = scores(sequences, make)
        if number == 0:
            print(f"| tracker | {' | '.join(row)} |\n|---{'|---' * len(row)}|")
        print(f"| {name} | {' | '.join(f'{v:.2f}' for v in row.values())} |", flush=True)


# Speed


def milliseconds_per_frame(make: Callable[[], Tracker], n: int, seed: int, frames: int = 500) -> FloatArray:
    """(frames,) duration of each update with `n` cars around a vehicle at 15 m/s, some coming and going [ms]."""
    rng = np.random.default_rng([seed, n])
    xy = np.column_stack([rng.uniform(-100.0, 100.0, n), rng.uniform(-40.0, 40.0, n)])
    speed = rng.choice([0.0, 12.0, -12.0], n, p=[0.5, 0.25, 0.25]) - 15.0
    size = np.tile([4.5, 1.9, 1.6], (n, 1))
    tracker, durations = make(), []
    for _ in range(frames + 20):
        xy[:, 0] = (xy[:, 0] + 0.1 * speed + 100.0) % 200.0 - 100.0
        seen = np.column_stack([xy + rng.normal(0.0, 0.15, (n, 2)), np.zeros(n)])
        boxes = Boxes(seen, size, np.where(speed < -20.0, np.pi, 0.0))
        start = time.perf_counter()
        tracker.update(boxes)
        durations.append(1e3 * (time.perf_counter() - start))
    return np.array(durations[20:])


def speed_table(seed: int) -> None:
    """Print durations over the number of objects."""
    print("\nSpeed, one process: 5th, 50th and 95th percentile of an update [ms]; a shared machine raises the latter\n")
    print("| tracker | 10 objects | 50 | 200 | 500 | frames/s at 50 (median) |\n|---|---|---|---|---|---|")
    for name, make in TRACKERS.items():
        columns = {n: milliseconds_per_frame(make, n, seed, 500 if n <= 50 else 100) for n in (10, 50, 200, 500)}
        cells = " | ".join(", ".join(f"{v:.2f}" for v in np.percentile(c, (5, 50, 95))) for c in columns.values())
        print(f"| {name} | {cells} | {1e3 / np.median(columns[50]):,.0f} |", flush=True)


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0, help="of the simulated detections and of the speed test")
    parser.add_argument("--only", choices=["speed", "kitti", "v2v4real", "opv2v"], help="one part")
    arguments = parser.parse_args()
    parts = [arguments.only] if arguments.only else ["speed", "kitti", "v2v4real", "opv2v"]
    if parts != ["speed"] and not DATA.is_dir():
        sys.exit(f"no data in {DATA}: set COBEVGLUE_DATA, or run with --only speed")
    print_head(f"seed {arguments.seed}")
    if "speed" in parts:
        speed_table(arguments.seed)
    if "kitti" in parts:
        hota = {threshold: scores([kitti(s, threshold) for s in KITTI_TUNED], Sort)["HOTA"] for threshold in range(10)}
        best = max(hota, key=lambda threshold: hota[threshold])
        print("\nKITTI, HOTA of Sort by score threshold on", ", ".join(KITTI_TUNED), end=": ")
        print(", ".join(f"{threshold}: {value:.1f}" for threshold, value in hota.items()), f"-> {best}")
        table(f"KITTI {' '.join(KITTI_TUNED)} (threshold chosen here)", [kitti(s, best) for s in KITTI_TUNED])
        table(f"KITTI {' '.join(KITTI_CONFIRMED)} (confirmed here)", [kitti(s, best) for s in KITTI_CONFIRMED])
    if "v2v4real" in parts:
        for split, sequences in V2V4REAL.items():
            for swerving in (False, True):
                what = f"V2V4Real {split} ({'settings chosen' if split == 'train' else 'confirmed'} here)"
                agents = [(s, agent) for s in sequences for agent in ("ego", "other")]
                table(what + ", swerving" * swerving, [v2v4real(split, s, agent, swerving) for s, agent in agents])
    if "opv2v" in parts:
        agents = [(f"{count}Cars_1", f"car{k + 1}") for count, n in (("Two", 2), ("Three", 3)) for k in range(n)]
        table("OPV2V Culver City, true boxes with detection errors", [opv2v(s, a, arguments.seed) for s, a in agents])


if __name__ == "__main__":
    main()
