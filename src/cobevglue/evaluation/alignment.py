"""Evaluation of aligners: pose errors by frame, by number of co-visible objects.

*Landing error*: mean distance between other's boxes transformed by the estimated and by the true pose [m]. It measures
the effect on a user of the pose and, unlike the translation error, does not depend on the origins of the frames.

*Right*: accepted with a landing error below 3 m. *Wrong*: accepted but not right. *Success at k*: accepted with a
translation error below k m and a yaw error below k degrees. A refusal is neither right nor wrong.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from cobevglue.alignment.alignment import Aligner, Alignment
from cobevglue.alignment.own_body import known_bodies
from cobevglue.boxes import Boxes
from cobevglue.se2 import SE2, wrap_angle
from cobevglue.typing import IntArray

__all__ = [
    "AlignmentSequence",
    "PairFrame",
    "Record",
    "Summary",
    "by_co_visible",
    "evaluate",
    "landing_error",
    "normalised_error",
    "off_by_3",
    "summarise",
]

RIGHT = 3.0
"""Landing error of a right pose [m]."""

_GROUPS = {"all": (0, None), "0": (0, 0), "1": (1, 1), "2": (2, 2), "3": (3, 3), ">= 2": (2, None), ">= 4": (4, None)}
"""Groups of frames by number of co-visible objects: first and last."""


@dataclass(frozen=True, eq=False, slots=True)
class PairFrame:
    """Tracked boxes of two agents in one frame, and the ground truth.

    Attributes:
        ego: tracked boxes in ego's frame.
        other: tracked boxes in other's frame.
        ego_SE2_other: the true relative pose.
        co_visible: number of objects that both detected.
        pairs: (K, 2) rows of ego and other that are the same object; None if unknown.
        ego_body: one-row box of the ego's own vehicle in the ego frame, or None.
        other_body: likewise of the other agent, in its own frame.
        time: of the frame [s]; None for 0.1 s after the previous one.
        time_offset: the true time offset of the other's list [s]; NaN if unknown.
    """

    ego: Boxes
    other: Boxes
    ego_SE2_other: SE2
    co_visible: int
    pairs: IntArray | None = None
    ego_body: Boxes | None = None
    other_body: Boxes | None = None
    time: float | None = None
    time_offset: float = math.nan


@dataclass(frozen=True, eq=False, slots=True)
class AlignmentSequence:
    """Frames of one pair of agents, 0.1 s apart."""

    name: str
    frames: list[PairFrame]


@dataclass(frozen=True, slots=True)
class Record:
    """Result of an aligner in one frame. Errors are infinite if it refused; `seconds` is the duration of the call.

    `time_offset_error` [s] is NaN if it refused or the true offset is unknown. `risk` is the stated one; `nees` is the
    normalised estimation error squared of x, y and yaw (mean 3 where the covariance is right), NaN if it refused.
    """

    sequence: str
    co_visible: int
    accepted: bool
    translation_error: float
    yaw_error: float
    landing_error: float
    true_matches: int
    found_matches: int
    possible_matches: int
    seconds: float
    time_offset_error: float = math.nan
    risk: float = math.nan
    nees: float = math.nan

    @property
    def right(self) -> bool:
        """Whether the alignment was accepted with a landing error below 3 m."""
        return self.accepted and self.landing_error < RIGHT

    def success(self, k: float) -> bool:
        """Whether the alignment was accepted with errors below k metres and k degrees."""
        return self.accepted and self.translation_error < k and self.yaw_error < math.radians(k)


@dataclass(frozen=True, slots=True)
class Summary:
    """Fractions over a set of frames; NaN where the denominator is 0."""

    frames: int
    right: float
    refused: float
    wrong_of_accepted: float
    success_1: float
    success_2: float
    success_3: float
    match_precision: float
    match_recall: float
    median_milliseconds: float


def landing_error(estimate: SE2, truth: SE2, other: Boxes) -> float:
    """Mean distance between other's box centres transformed by two poses [m]; without boxes, that of its origin."""
    points = other.center[:, :2] if len(other) else np.zeros((1, 2))
    gap = estimate.apply(points) - truth.apply(points)
    return float(np.hypot(gap[:, 0], gap[:, 1]).mean())


def normalised_error(alignment: Alignment, truth: SE2) -> float:
    """Squared error of x, y and yaw of an accepted pose, normalised by its covariance (NEES)."""
    assert alignment.ego_SE2_other is not None
    estimate = alignment.ego_SE2_other
    error = np.array([estimate.x - truth.x, estimate.y - truth.y, wrap_angle(estimate.yaw - truth.yaw)])
    if not np.isfinite(alignment.covariance).all():
        return math.nan
    return float(error @ np.linalg.pinv(alignment.covariance) @ error)


def evaluate(sequences: Iterable[AlignmentSequence], make_aligner: Callable[[], Aligner]) -> Iterator[Record]:
    """Run a new aligner on each sequence, in order."""
    for sequence in sequences:
        aligner = make_aligner()
        for frame in sequence.frames:
            bodies = known_bodies(frame.ego_body, frame.other_body)
            start = time.perf_counter()
            alignment = aligner.align(frame.ego, frame.other, frame.time, **bodies)
            seconds = time.perf_counter() - start
            translation = yaw = landing = math.inf
            nees = math.nan
            if alignment.ego_SE2_other is not None:
                nees = normalised_error(alignment, frame.ego_SE2_other)
                translation, yaw = alignment.ego_SE2_other.error_to(frame.ego_SE2_other)
                landing = landing_error(alignment.ego_SE2_other, frame.ego_SE2_other, frame.other)
            true, possible = _count_matches(alignment.matches, frame.pairs)
            yield Record(
                sequence.name,
                frame.co_visible,
                alignment.accepted,
                translation,
                yaw,
                landing,
                true,
                len(alignment.matches) if frame.pairs is not None else 0,
                possible if alignment.accepted else 0,
                seconds,
                abs(alignment.time_offset - frame.time_offset) if alignment.accepted else math.nan,
                alignment.risk,
                nees,
            )


def _count_matches(found: IntArray, pairs: IntArray | None) -> tuple[int, int]:
    """Number of correct matches among `found`, and number of true matches."""
    if pairs is None:
        return 0, 0
    truth = set(map(tuple, pairs.tolist()))
    return sum(pair in truth for pair in map(tuple, found.tolist())), len(truth)


def summarise(records: Iterable[Record], wrong: Callable[[Record], bool] = lambda r: not r.right) -> Summary:
    """Compute the fractions over a set of frames.

    Args:
        records: of the frames.
        wrong: predicate of wrong alignments among the accepted ones; by default a landing error of 3 m or more.
    """
    rows = list(records)
    accepted = [r for r in rows if r.accepted]

    def share(part: float, whole: float) -> float:
        return part / whole if whole else math.nan

    n = len(rows)
    true = sum(r.true_matches for r in rows)
    return Summary(
        frames=n,
        right=share(sum(r.right for r in rows), n),
        refused=share(n - len(accepted), n),
        wrong_of_accepted=share(sum(wrong(r) for r in accepted), len(accepted)),
        success_1=share(sum(r.success(1.0) for r in rows), n),
        success_2=share(sum(r.success(2.0) for r in rows), n),
        success_3=share(sum(r.success(3.0) for r in rows), n),
        match_precision=share(true, sum(r.found_matches for r in rows)),
        match_recall=share(true, sum(r.possible_matches for r in rows)),
        median_milliseconds=1e3 * float(np.median([r.seconds for r in rows])) if rows else math.nan,
    )


def off_by_3(record: Record) -> bool:
    """Whether an error exceeds 3 m or 3 degrees: the stricter criterion of wrong, for exact ground truth."""
    return not record.success(3.0)


def by_co_visible(
    records: Sequence[Record], wrong: Callable[[Record], bool] = lambda r: not r.right
) -> dict[str, Summary]:
    """Summarise frames by number of co-visible objects; groups without frames are omitted."""
    groups = {}
    for name, (first, last) in _GROUPS.items():
        part = [r for r in records if r.co_visible >= first and (last is None or r.co_visible <= last)]
        if part:
            groups[name] = summarise(part, wrong)
    return groups
