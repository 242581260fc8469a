"""Sequences to evaluate aligners on: from recorded detections, from noisy labels, or from clouds through a detector.

V2V4Real's detection files store the boxes of both cars in ego's frame. Other's boxes are therefore transformed into a
frame with a smooth trajectory before they are tracked and aligned.
"""

from __future__ import annotations

import csv
import itertools
import math
from collections.abc import Callable, Iterable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np
from scipy.optimize import linear_sum_assignment

from cobevglue.boxes import Boxes
from cobevglue.datasets import AgentFrame, Dataset, Scenario
from cobevglue.datasets.tracking_text import count_frames, read_v2v4real_detections, read_v2v4real_labels
from cobevglue.disturbance.detection_errors import DetectionErrors, add_detection_errors
from cobevglue.evaluation.alignment import AlignmentSequence, PairFrame
from cobevglue.iou import bev_iou
from cobevglue.se2 import SE2
from cobevglue.tracking import Sort
from cobevglue.typing import Float32Array, IntArray

__all__ = [
    "V2V4REAL_TRAIN",
    "V2V4REAL_VAL",
    "Perceived",
    "Perceiver",
    "noisy_label_sequences",
    "perceived_sequences",
    "smooth_trajectory",
    "v2v4real_car_sequences",
    "v2v4real_sequences",
]

V2V4REAL_TRAIN = tuple(f"train/{i:04d}" for i in range(11))
"""Detection sequences that the defaults were tuned on."""
V2V4REAL_VAL = ("val/0001", "val/0004", "val/0005", "val/0008")
"""Detection sequences that were not used in the numeric search, without val/0000, a duplicate of train/0000."""

_FRAME = 0.1
_DETECTED_WITHIN, _DETECTED_TURN = 2.5, math.radians(30.0)
"""Maximum distance [m] and heading difference modulo pi [rad] of a detection from its labelled object."""
_DETECTED_IOU = 0.1
"""Minimum bird's-eye-view IoU (exclusive) of a detection and its object, where the labels are exact."""
_TRAJECTORY_STREAM, _ERROR_STREAM = 0, 1
_FALSE = np.iinfo(np.int64).min
"""Object id of a false box; no data set uses it."""


def smooth_trajectory(seed: int, frames: int) -> list[SE2]:
    """A smooth random trajectory of a car: poses in the scene, 0.1 s apart.

    Up to 15 m/s and 0.15 rad/s, both changing slowly, from a random position within 40 m of the origin on each axis.
    """
    rng = np.random.default_rng([seed, _TRAJECTORY_STREAM])
    x, y = rng.uniform(-40.0, 40.0, 2)
    pose = SE2(x, y, rng.uniform(-math.pi, math.pi))
    speed, turn = rng.uniform(-12.0, 12.0), rng.uniform(-0.15, 0.15)
    phase = rng.uniform(0.0, 2.0 * math.pi)
    poses = []
    for i in range(frames):
        poses.append(pose)
        v = speed * (1.0 + 0.3 * math.sin(0.05 * i + phase))
        w = turn * math.sin(0.03 * i + phase)
        pose = pose @ SE2(v * _FRAME, 0.0, w * _FRAME)
    return poses


def v2v4real_sequences(
    root: Path, names: tuple[str, ...], seed: int = 0, min_score: float = 0.0, moving: bool = True
) -> list[AlignmentSequence]:
    """Recorded PointPillars detections of two real cars.

    Args:
        root: folder with `train` and `val`, as `shared/data/v2v4real_detections`.
        names: such as "val/0004".
        seed: of the trajectory of other's frame.
        min_score: detections with lower scores are dropped before tracking.
        moving: other's frame moves along the trajectory; otherwise it stays at its first pose. The stored lists are not
            of one instant: only in a frame that stays does a list that is late in the world look late.
    """
    return [_v2v4real_sequence(root, name, seed, min_score, moving) for name in names]


def _v2v4real_sequence(root: Path, name: str, seed: int, min_score: float, moving: bool) -> AlignmentSequence:
    split, number = name.split("/")
    files = [root / split / side / f"{number}.txt" for side in ("ego", "other", "labels")]
    n = count_frames(*files)
    ego_boxes, other_boxes = (read_v2v4real_detections(file, n) for file in files[:2])
    labels = read_v2v4real_labels(files[2], n)
    trajectory = smooth_trajectory(seed * 1000 + int(number) + 100 * (split == "val"), n)
    if not moving:
        trajectory = trajectory[:1] * n
    ego_tracker, other_tracker = Sort(), Sort()
    frames = []
    for ego, other, label, ego_SE2_other in zip(ego_boxes, other_boxes, labels, trajectory, strict=True):
        ego, other = _filter_by_score(ego, min_score), _filter_by_score(other, min_score)
        both = set(_detected(label, ego)) & set(_detected(label, other))
        moved = other.transform(ego_SE2_other.inverse())
        frames.append(PairFrame(ego_tracker.update(ego), other_tracker.update(moved), ego_SE2_other, len(both)))
    return AlignmentSequence(name, frames)


def v2v4real_car_sequences(root: Path, cars: Path, names: tuple[str, ...], bodies: bool) -> list[AlignmentSequence]:
    """Recorded detections of two real cars, each list in its own car's frame.

    The other car's frame is that of its label: origin at the box centre, x along the heading. Frames without a label
    of the other car are omitted, since its pose is unknown, and so are sequences without any.

    Args:
        root: folder with `train` and `val`, as `shared/data/v2v4real_detections`.
        cars: table of the labels that are the two cars, as `shared/data/v2v4real_cars.csv`.
        names: such as "val/0004".
        bodies: pass each agent's own vehicle to the aligner. The ego's is the median of its labels.
    """
    with cars.open(newline="") as file:
        ids = {
            (f"{row['split']}/{int(row['sequence']):04d}", row["car"]): int(row["label_id"])
            for row in csv.DictReader(file)
        }
    known = [name for name in names if (name, "other") in ids]
    return [_v2v4real_car_sequence(root, name, ids[name, "other"], ids.get((name, "ego")), bodies) for name in known]


def _v2v4real_car_sequence(root: Path, name: str, other_id: int, ego_id: int | None, bodies: bool) -> AlignmentSequence:
    split, number = name.split("/")
    files = [root / split / side / f"{number}.txt" for side in ("ego", "other", "labels")]
    n = count_frames(*files)
    ego_boxes, other_boxes = (read_v2v4real_detections(file, n) for file in files[:2])
    labels = read_v2v4real_labels(files[2], n)
    ego_body = _median_box([_with_id(label, ego_id) for label in labels]) if bodies else None
    ego_tracker, other_tracker = Sort(), Sort()
    frames = []
    for i, (ego, other, label) in enumerate(zip(ego_boxes, other_boxes, labels, strict=True)):
        car = _with_id(label, other_id)
        if not len(car):
            continue
        ego_SE2_other = SE2(car.center[0, 0], car.center[0, 1], car.yaw[0])
        moved = other.transform(ego_SE2_other.inverse())
        frames.append(
            PairFrame(
                ego_tracker.update(ego, _FRAME * i),
                other_tracker.update(moved, _FRAME * i),
                ego_SE2_other,
                len(set(_detected(label, ego)) & set(_detected(label, other))),
                ego_body=ego_body,
                other_body=car.transform(ego_SE2_other.inverse()).replace(track_id=None) if bodies else None,
                time=_FRAME * i,
            )
        )
    return AlignmentSequence(name, frames)


def _with_id(labels: Boxes, track_id: int | None) -> Boxes:
    """The row with this id, or no rows."""
    if track_id is None or labels.track_id is None:
        return labels[:0]
    return labels[labels.track_id == track_id]


def _median_box(boxes: Iterable[Boxes]) -> Boxes:
    """The median box of one vehicle; a default car at the origin without boxes."""
    rows = Boxes.concatenate([part.replace(track_id=None) for part in boxes])
    if not len(rows):
        return Boxes([(0.0, 0.0, -1.0)], [(4.5, 1.9, 1.6)], [0.0])
    return Boxes(np.median(rows.center, axis=0)[None], np.median(rows.size, axis=0)[None], [np.median(rows.yaw)])


def _filter_by_score(boxes: Boxes, min_score: float) -> Boxes:
    return boxes if boxes.score is None or min_score <= 0.0 else boxes[boxes.score >= min_score]


def _detected(labels: Boxes, detections: Boxes) -> IntArray:
    """Rows of the labels that are matched one-to-one to a detection, by distance and heading modulo pi."""
    gap = np.linalg.norm(labels.center[:, None, :2] - detections.center[None, :, :2], axis=-1)
    turn = np.abs((labels.yaw[:, None] - detections.yaw[None, :] + math.pi / 2) % math.pi - math.pi / 2)
    cost = np.where((gap < _DETECTED_WITHIN) & (turn < _DETECTED_TURN), gap, 1e3)
    rows, columns = linear_sum_assignment(cost)
    found: IntArray = rows[cost[rows, columns] < 1e3]
    return found


def noisy_label_sequences(
    dataset: Dataset, errors: DetectionErrors, seed: int = 0, max_range: float = math.inf, late: int = 0
) -> Iterator[AlignmentSequence]:
    """Sequences of every pair of agents of every scenario: labels with detection errors, tracked.

    Args:
        dataset: its object ids are the same for all agents (OPV2V, V2XSet).
        errors: model of the detection errors.
        seed: of the errors.
        max_range: objects farther from an agent are not detected [m].
        late: the other agent's list is this many frames old; the true pose is that at the ego's instant.
    """
    for index, scenario in enumerate(dataset):
        names = sorted({name for frame in scenario for name in frame.agents})
        detected = [
            _detect(scenario, name, errors, [seed, _ERROR_STREAM, index, j], max_range) for j, name in enumerate(names)
        ]
        for a, b in itertools.combinations(range(len(names)), 2):
            frames = []
            for i, frame in enumerate(scenario):
                if i in detected[a] and i in detected[b] and i - late in detected[b]:
                    ego, other = frame.agents[names[a]], frame.agents[names[b]]
                    pair = _pair_frame(detected[a][i], ego, detected[b][i - late], other)
                    frames.append(replace(pair, time_offset=-_FRAME * late))
            yield AlignmentSequence(f"{scenario.name}/{names[a]}-{names[b]}", frames)


def _detect(
    scenario: Scenario, name: str, errors: DetectionErrors, key: list[int], max_range: float
) -> dict[int, tuple[Boxes, IntArray]]:
    """Tracked noisy boxes of one agent and their true object ids (`_FALSE` for false boxes), by frame number."""
    tracker, detected = Sort(), {}
    for i, frame in enumerate(scenario):
        if name not in frame.agents:
            continue
        objects = frame.agents[name].objects
        objects = objects[np.hypot(objects.center[:, 0], objects.center[:, 1]) < max_range]
        if objects.track_id is None and len(objects):
            raise ValueError(f"{scenario.name}: {name}: objects have no ids, so co-visible objects are unknown")
        boxes, rows = add_detection_errors(objects, errors, np.random.default_rng([*key, i]))
        ids = np.full(len(rows), _FALSE)
        if objects.track_id is not None:
            ids[rows >= 0] = objects.track_id[rows[rows >= 0]]
        detected[i] = tracker.update(boxes), ids
    return detected


def _pair_frame(
    ego: tuple[Boxes, IntArray], ego_agent: AgentFrame, other: tuple[Boxes, IntArray], other_agent: AgentFrame
) -> PairFrame:
    """A frame from the boxes of two agents, each with the true object ids of its boxes (`_FALSE` for false ones)."""
    (ego_boxes, ego_ids), (other_boxes, other_ids) = ego, other
    truth = SE2.from_matrix(np.linalg.inv(ego_agent.world_SE3_lidar) @ other_agent.world_SE3_lidar)
    pairs = np.argwhere((ego_ids[:, None] == other_ids[None, :]) & (ego_ids[:, None] != _FALSE))
    return PairFrame(ego_boxes, other_boxes, truth, len(pairs), pairs)


class Perceived(Protocol):
    """Perception output of one agent, such as `PerceptionOutput`."""

    @property
    def boxes(self) -> Boxes:
        """Tracked boxes in the agent's LiDAR frame."""
        ...


class Perceiver(Protocol):
    """Detector and tracker of one agent, such as `Perception`."""

    def step(self, points: Float32Array, /) -> Perceived:
        """Process the agent's next cloud (N, 4)."""
        ...


def perceived_sequences(
    scenarios: Iterable[Scenario], make_perceiver: Callable[[], Perceiver]
) -> Iterator[AlignmentSequence]:
    """Sequences of every pair of agents of every scenario: boxes detected in each agent's own clouds and tracked.

    Frames in which one of the two has no cloud are omitted.

    Args:
        scenarios: with clouds, exact poses and object ids.
        make_perceiver: creates the detector and tracker of an agent; called once for each.
    """
    for scenario in scenarios:
        names = sorted({name for frame in scenario for name in frame.agents})
        perceivers = {name: make_perceiver() for name in names}
        frames: dict[tuple[str, str], list[PairFrame]] = {pair: [] for pair in itertools.combinations(names, 2)}
        for frame in scenario:
            perceived = {
                name: (_with_ids(perceivers[name].step(agent.points).boxes, agent.objects), agent)
                for name, agent in frame.agents.items()
                if agent.points is not None
            }
            for (ego, other), pair_frames in frames.items():
                if ego in perceived and other in perceived:
                    pair_frames.append(_pair_frame(*perceived[ego], *perceived[other]))
        for (ego, other), pair_frames in frames.items():
            if pair_frames:
                yield AlignmentSequence(f"{scenario.name}/{ego}-{other}", pair_frames)


def _with_ids(detections: Boxes, objects: Boxes) -> tuple[Boxes, IntArray]:
    """The detections, and the object id of each (`_FALSE` without one): the one-to-one assignment of largest IoU."""
    assert objects.track_id is not None
    iou = bev_iou(detections, objects)
    rows, columns = linear_sum_assignment(-iou)
    overlapping = iou[rows, columns] > _DETECTED_IOU
    ids = np.full(len(detections), _FALSE)
    ids[rows[overlapping]] = objects.track_id[columns[overlapping]]
    return detections, ids
