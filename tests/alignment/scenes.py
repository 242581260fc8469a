"""Small scenes with a known answer, for the tests of this folder."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache

import numpy as np

from cobevglue import SE2, Boxes
from cobevglue.alignment import Alignment
from cobevglue.se2 import wrap_angle
from cobevglue.simulation import Junction, ObjectListFrame
from cobevglue.typing import FloatArray, IntArray

CAR = (4.5, 1.9, 1.6)
NOISE = (0.15, math.radians(1.5), 0.2, 0.05)
"""Of the centres [m], headings [rad], lengths and widths [m], in each list: a good detector."""


def cars(rows: Sequence[Sequence[float]], size: Sequence[float] = CAR) -> Boxes:
    """Equal cars at (x [m], y [m], yaw [degrees])."""
    table = np.array(rows, dtype=float).reshape(-1, 3)
    n = len(table)
    return Boxes(np.column_stack([table[:, :2], np.zeros(n)]), np.tile(size, (n, 1)), np.radians(table[:, 2]))


def mirrored(boxes: Boxes) -> Boxes:
    """The scene in a mirror: y and yaw change sign."""
    return boxes.replace(center=boxes.center * (1.0, -1.0, 1.0), yaw=-boxes.yaw)


def with_ids(boxes: Boxes, first: int = 0) -> Boxes:
    """Track ids `first`, `first` + 1, … in the order of the rows."""
    return boxes.replace(track_id=np.arange(first, first + len(boxes)))


def random_pose(rng: np.random.Generator, reach: float = 60.0) -> SE2:
    x, y = rng.uniform(-reach, reach, 2)
    return SE2(x, y, rng.uniform(-math.pi, math.pi))


def random_boxes(n: int, rng: np.random.Generator, reach: float = 50.0, apart: float = 6.0) -> Boxes:
    """Vehicles of different lengths, at random places and with random headings, none closer than `apart` [m]."""
    places: list[FloatArray] = []
    while len(places) < n:
        place = rng.uniform(-reach, reach, 2)
        if all(math.hypot(*(place - p)) > apart for p in places):
            places.append(place)
    long = rng.random(n) < 0.2
    length = np.where(long, rng.uniform(7.0, 12.0, n), rng.uniform(3.8, 5.2, n))
    width = np.where(long, 2.5, rng.uniform(1.7, 2.1, n))
    center = np.column_stack([np.reshape(places, (n, 2)), np.zeros(n)])
    return Boxes(center, np.column_stack([length, width, np.full(n, 1.6)]), rng.uniform(-math.pi, math.pi, n))


def detected(boxes: Boxes, rng: np.random.Generator, noise: tuple[float, float, float, float] = NOISE) -> Boxes:
    """The boxes with Gaussian errors, in place of a detector."""
    n = len(boxes)
    center = boxes.center + np.column_stack([rng.normal(0.0, noise[0], (n, 2)), np.zeros(n)])
    size = boxes.size + rng.normal(0.0, 1.0, (n, 3)) * (noise[2], noise[3], 0.0)
    return boxes.replace(center=center, size=np.maximum(size, 0.5), yaw=boxes.yaw + rng.normal(0.0, noise[1], n))


@dataclass(frozen=True, eq=False)
class Pair:
    """What two agents see, and the truth."""

    ego: Boxes
    other: Boxes
    ego_SE2_other: SE2
    matches: IntArray


def pair_of_views(
    common: int,
    seed: int,
    only_ego: int = 0,
    only_other: int = 0,
    noise: tuple[float, float, float, float] = NOISE,
    reach: float = 50.0,
) -> Pair:
    """Two agents that see `common` objects both, and some that only one of them sees; rows are in random order."""
    rng = np.random.default_rng([seed, 0, 0])
    world = random_boxes(common + only_ego + only_other, rng, reach)
    ego_SE2_world, other_SE2_world = random_pose(rng), random_pose(rng)
    ego_rows = rng.permutation(common + only_ego)
    other_rows = rng.permutation(np.r_[0:common, common + only_ego : common + only_ego + only_other])
    ego = detected(world[ego_rows].transform(ego_SE2_world), rng, noise)
    other = detected(world[other_rows].transform(other_SE2_world), rng, noise)
    matches = np.argwhere(ego_rows[:, None] == other_rows[None, :])
    return Pair(ego, other, ego_SE2_world @ other_SE2_world.inverse(), matches)


def pairs_of(alignment: Alignment) -> set[tuple[int, int]]:
    """The matches as a set of (row of ego, row of other)."""
    return {(int(m), int(n)) for m, n in alignment.matches}


def error_at(pose: SE2 | None, truth: SE2, boxes: Boxes) -> float:
    """How far other's boxes land from where they belong, on average [m]; infinite without a pose."""
    if pose is None:
        return math.inf
    if len(boxes) == 0:
        return pose.error_to(truth)[0]
    gap = pose.apply(boxes.center) - truth.apply(boxes.center)
    return float(np.hypot(gap[:, 0], gap[:, 1]).mean())


@cache
def junction(seed: int) -> tuple[ObjectListFrame, ...]:
    """The first four seconds of a junction: simulated once, used by many tests."""
    scene = Junction(seed)
    return tuple(scene[i] for i in range(40))


def drive(
    common: int,
    seed: int,
    only_each: int = 4,
    frames: int = 30,
    missed: float = 0.1,
    first_id: int | None = None,
) -> list[Pair]:
    """Two agents drive past standing objects at 10 Hz, each in its own bend; some are common, some seen by one only.

    What one agent alone sees lies 60 m to one side, out of the other's view.

    With `first_id` the boxes have track ids from there on, and those of the two agents have nothing to do with each
    other.
    """
    rng = np.random.default_rng([seed, 1, 0])
    world = random_boxes(common + 2 * only_each, rng)
    center = world.center.copy()
    center[common:, 1] += np.where(np.arange(2 * only_each) < only_each, 60.0, -60.0)
    world = world.replace(center=center)
    starts = [random_pose(rng, 40.0) for _ in range(2)]
    ego_sees = np.arange(common + only_each)
    other_sees = np.r_[0:common, common + only_each : len(world)]
    sequence = []
    for k in range(frames):
        ego_pose = starts[0] @ SE2(1.0 * k, 0.0, 0.01 * k)
        other_pose = starts[1] @ SE2(0.8 * k, 0.0, -0.01 * k)
        m = ego_sees[rng.random(len(ego_sees)) >= missed]
        n = other_sees[rng.random(len(other_sees)) >= missed]
        ego = detected(world[m].transform(ego_pose.inverse()), rng)
        other = detected(world[n].transform(other_pose.inverse()), rng)
        if first_id is not None:
            ego, other = ego.replace(track_id=first_id + m), other.replace(track_id=first_id + 10**6 - 7 * n)
        sequence.append(Pair(ego, other, ego_pose.inverse() @ other_pose, np.argwhere(m[:, None] == n[None, :])))
    return sequence


def content(alignment: Alignment) -> tuple[object, ...]:
    """Every bit of an alignment."""
    pose = alignment.ego_SE2_other
    return (
        None if pose is None else np.array([pose.x, pose.y, pose.yaw]).tobytes(),
        alignment.matches.tobytes(),
        alignment.covariance.tobytes(),
        np.array([alignment.evidence, alignment.margin]).tobytes(),
        alignment.reason,
    )


def mahalanobis(alignment: Alignment, truth: SE2) -> float:
    """The squared error in units of what the covariance promises: 3 on average if that is honest."""
    pose = alignment.ego_SE2_other
    assert pose is not None
    error = np.array([pose.x - truth.x, pose.y - truth.y, float(wrap_angle(pose.yaw - truth.yaw))])
    return float(error @ np.linalg.solve(alignment.covariance, error))
