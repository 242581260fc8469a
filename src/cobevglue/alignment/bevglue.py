"""BEVGlue: the relative pose between two agents from the objects both see (paper, section 4)."""

from __future__ import annotations

import math
from importlib import import_module
from types import ModuleType

import numpy as np

from cobevglue.alignment.alignment import Alignment
from cobevglue.alignment.common_subgraph import common_subgraph, surviving_pairs
from cobevglue.alignment.config import BEVGlueConfig
from cobevglue.alignment.hypotheses import PoseHypothesis, from_records
from cobevglue.alignment.object_graph import ObjectGraph
from cobevglue.alignment.own_body import append_body, check_bodies
from cobevglue.alignment.procrustes import procrustes
from cobevglue.boxes import Boxes
from cobevglue.clock import Clock
from cobevglue.se2 import SE2
from cobevglue.typing import FloatArray, IntArray

__all__ = ["BEVGlue"]

_FRAME = 0.1
"""Time between frames when none is given [s]."""
_SAME_CLOCK = 1.0
"""Time stamps that differ by more are of different clocks [s]."""


class BEVGlue:
    """Finds where another agent is, from two lists of boxes and nothing else. One for each collaborator.

        glue = BEVGlue()
        alignment = glue.align(ego, other)
        if alignment.accepted:
            boxes = other.transform(alignment.ego_SE2_other)

    It remembers: frame after frame it follows several candidate poses and reports the best one once it is clearly
    better than the others. Call `reset` when the frames do not continue the last ones.
    """

    def __init__(self, config: BEVGlueConfig | None = None) -> None:
        """Start with nothing seen; the default settings are the robust variant."""
        self.config = config or BEVGlueConfig()
        self._matcher = (
            _PaperMatcher(self.config) if self.config.method == "affinity" else _EvidenceMatcher(self.config)
        )
        self._clock = Clock(_FRAME)
        self._other_time: float | None = None

    def align(
        self,
        ego: Boxes,
        other: Boxes,
        time: float | None = None,
        other_time: float | None = None,
        *,
        ego_body: Boxes | None = None,
        other_body: Boxes | None = None,
    ) -> Alignment:
        """The relative pose in this frame, or a refusal with its reason.

        An agent's own vehicle is an object to the other agent, which no detector of its own reports. Where it is given,
        it takes part like any box, and a pose that places one vehicle into the other is refused.

        Args:
            ego: boxes in ego's frame, with track ids if there are any.
            other: the collaborator's boxes in its own frame.
            time: of the ego's boxes [s], on any clock; 0.1 s after the last call by default.
            other_time: the collaborator's own time stamp of its list [s], on the same clock or another one; `time` by
                default. If the two clocks differ by more than a second, only the steps of `other_time` are used.
            ego_body: one-row box of the ego's own vehicle in the ego frame, if it is known.
            other_body: one-row box of the collaborator's own vehicle in its own frame, as it transmits it.

        With `BEVGlueConfig(time_offset=True)` the list of the collaborator may be of another instant: the offset is
        estimated from the velocities of its tracks, and the pose is that at the ego's instant. Without, the two lists
        are taken to be of one instant.

        Returns:
            The pose with the matches of `ego` and `other`; matches of own vehicles are not listed.

        Raises:
            ValueError: `time` is not finite, not in seconds or not later than the last call's, or a body has not one
                row.
            TypeError: a list is no `Boxes`.
        """
        for name, boxes in (("ego", ego), ("other", other)):
            if not isinstance(boxes, Boxes):
                raise TypeError(f"{name} must be Boxes, got {type(boxes).__name__}")
        with_bodies = append_body(ego, ego_body, "ego_body"), append_body(other, other_body, "other_body")
        two_vehicles = ego_body is not None and other_body is not None
        dt = self._advance_clock(time)
        other_dt, stamps = self._advance_other_clock(dt, other_time)
        if not self.config.time_offset:
            stamps = 0.0
        alignment = self._matcher.align(
            *with_bodies, dt, other_dt, stamps, last_differ=two_vehicles, other_body=other_body is not None
        )
        return check_bodies(alignment, ego, other, ego_body, other_body)

    @property
    def hypotheses(self) -> tuple[PoseHypothesis, ...]:
        """The poses that fit the lists of the last call, accepted or not, best first; () for the paper's method."""
        return self._matcher.hypotheses

    def reset(self) -> None:
        """Forget all frames."""
        self._clock.reset()
        self._other_time = None
        self._matcher.reset()

    def _advance_clock(self, time: float | None) -> float:
        """Seconds since the last call; after a gap that is too long everything is forgotten."""
        first = self._clock.time is None
        step = self._clock.advance(time)
        if not first and step > self.config.max_gap:
            self._matcher.reset()
            return _FRAME
        return step

    def _advance_other_clock(self, dt: float, other_time: float | None) -> tuple[float, float]:
        """Seconds between the collaborator's last list and this one, and its stamp minus the ego's (0 if unknown)."""
        before, self._other_time = self._other_time, other_time
        if other_time is None:
            return dt, 0.0
        if not math.isfinite(other_time):
            raise ValueError(f"other_time must be finite, got {other_time}")
        stamps = other_time - (self._clock.time or 0.0)
        step = dt if before is None else max(other_time - before, 0.0)
        return step, stamps if abs(stamps) <= _SAME_CLOCK else 0.0


class _PaperMatcher:
    """The method as printed: graphs, temporally consistent maximum common subgraph, SVD."""

    hypotheses: tuple[PoseHypothesis, ...] = ()

    def __init__(self, config: BEVGlueConfig) -> None:
        self._config = config
        self.reset()

    def reset(self) -> None:
        self._track_pairs: IntArray = np.zeros((0, 2), np.int64)

    def align(
        self, ego: Boxes, other: Boxes, dt: float, other_dt: float, stamps: float, last_differ: bool, other_body: bool
    ) -> Alignment:
        ego_graph, other_graph = ObjectGraph.of(ego), ObjectGraph.of(other)
        carried = surviving_pairs(ego_graph, other_graph, self._track_pairs)
        pairs, confidence = common_subgraph(
            ego_graph, other_graph, carried if len(carried) else None, self._config.affinity
        )
        if ego.track_id is not None and other.track_id is not None:
            self._track_pairs = np.column_stack([ego.track_id[pairs[:, 0]], other.track_id[pairs[:, 1]]])
        if len(pairs) < 2:
            return Alignment.refused("fewer than two common objects: no rotation", evidence=confidence)
        pose = procrustes(ego_graph.position[pairs[:, 0]], other_graph.position[pairs[:, 1]])
        arms = pose.rotation @ other_graph.position[pairs[:, 1]].T
        return Alignment(pose, pairs, _fit_covariance(arms, self._config.position_std), evidence=confidence)


class _EvidenceMatcher:
    """The robust variant: the best star by likelihood, hypotheses carried over time, a verdict."""

    def __init__(self, config: BEVGlueConfig) -> None:
        self._config = config
        self._kernels = _load_kernels()
        self._noise = self._kernels.NoiseModel(
            config.position_std,
            config.heading_std,
            config.length_std,
            config.width_std,
            config.size_gain,
            config.density,
            config.flip_probability,
            config.sizes,
            config.heading_flips,
            config.range_tolerance,
            config.one_to_one,
        )
        self._motion = self._kernels.Motion(
            config.acceleration,
            config.yaw_acceleration,
            config.speed_std,
            config.yaw_rate_std,
            config.correlation,
            config.memory,
            config.miss_memory,
            config.link_distance,
            config.link_angle,
            config.tracks,
            config.offset_std if config.time_offset else 0.0,
            config.offset_drift if config.time_offset else 0.0,
        )
        self._rounds = config.rounds if config.refit else 0
        self.reset()

    def reset(self) -> None:
        self._hypotheses = np.zeros(0, self._kernels.HYPOTHESIS)
        self._seen = 0
        self._choices = 0
        self._stamps = 0.0
        self._motion_of_other = _OtherMotion(self._config)

    @property
    def hypotheses(self) -> tuple[PoseHypothesis, ...]:
        return from_records(self._hypotheses, self._seen, self._choices, self._config)

    def align(
        self, ego: Boxes, other: Boxes, dt: float, other_dt: float, stamps: float, last_differ: bool, other_body: bool
    ) -> Alignment:
        if not self._config.temporal:
            self.reset()
        other_rows, other_ids = _bev_rows(other), _NO_IDS if other.track_id is None else other.track_id
        motion = self._motion_of_other
        motion.follow(other_rows, other_ids, other_dt, other_body)
        self._hypotheses, margin, landing_std, pairs, x, y, yaw, offset, covariance = self._kernels.advance(
            self._hypotheses,
            _bev_rows(ego),
            other_rows,
            _NO_IDS if ego.track_id is None else ego.track_id,
            other_ids,
            last_differ,
            dt,
            stamps,
            self._stamps,
            self._seen,
            self._noise,
            self._motion,
            self._config.tries,
            self._rounds,
        )
        self._seen += 1
        self._choices = len(ego) * len(other)
        self._stamps = stamps
        if not len(self._hypotheses):
            return Alignment.refused(_nothing_in_common(ego, other), evidence=0.0, margin=0.0)
        evidence = float(self._hypotheses[0]["evidence"])
        reason = self._doubt(len(pairs), self._choices, evidence, margin, landing_std) if self._config.verdict else ""
        if reason:
            return Alignment.refused(reason, evidence, margin)
        ego_SE2_list = SE2(x, y, yaw)
        ego_SE2_other, covariance = motion.at_ego_instant(ego_SE2_list, offset, covariance)
        velocity = other_rows[: len(other) - other_body, 5:]
        offset_std = (
            math.sqrt(max(float(self._hypotheses[0]["cov"][6, 6]), 0.0)) if self._config.time_offset else np.nan
        )
        return Alignment(
            ego_SE2_other, pairs, covariance, "", evidence, margin, offset, offset_std, ego_SE2_list, velocity
        )

    def _doubt(self, pairs: int, choices: int, evidence: float, margin: float, landing_std: float) -> str:
        """Why the best pose should not be trusted, or an empty string."""
        config = self._config
        if pairs == 0:
            return "no object in this frame supports the pose followed so far"
        least = config.min_evidence + config.min_evidence_per_choice * math.log(max(choices / 25.0, 1.0))
        if evidence < least:
            return f"too few common objects: evidence {evidence:.1f} nats, {least:.1f} needed"
        # One frame cannot tell a regular pattern from the same one shifted; frames in which things move can.
        least = max(config.min_margin, config.min_relative_margin * (1.0 + 1.0 / self._seen) * evidence)
        if margin < least:
            return f"ambiguous: a different pose is only {margin:.1f} nats behind, {least:.1f} needed"
        if landing_std > config.max_landing_std:
            return f"too uncertain: boxes would land within {landing_std:.1f} m, {config.max_landing_std:.1f} m allowed"
        return ""


class _OtherMotion:
    """Velocities of the other agent's tracks and of its frame, from its lists."""

    def __init__(self, config: BEVGlueConfig) -> None:
        track_motion: ModuleType = import_module("cobevglue.alignment.track_motion")  # untyped, as all kernels

        self._follow = track_motion.follow_tracks if config.time_offset else None
        self._noise = track_motion.TrackNoise()
        self._tracks = np.zeros(0, track_motion.TRACK)
        self._twist = np.zeros(3)
        self._twist_variance = np.array([self._noise.frame_speed**2] * 2 + [self._noise.frame_turn**2])

    def follow(self, rows: FloatArray, ids: IntArray, dt: float, own_body: bool) -> None:
        """Write the velocities over ground into the last two columns of `rows` (N, 7).

        The own vehicle, the last row, does not move in its own frame: over ground it moves against the twist.
        """
        if self._follow is None or dt <= 0.0:
            return
        n = len(rows) - own_body
        self._tracks, self._twist, self._twist_variance, motion = self._follow(
            self._tracks, self._twist, self._twist_variance, rows[:n], ids[:n], dt, self._noise
        )
        squared = (motion[:, :2] ** 2).sum(axis=1)
        # Shrunk towards 0 by their uncertainty, so that the noise of what stands still does not count as motion.
        shrinkage = np.maximum(0.0, 1.0 - _SHRINKAGE * motion[:, 2] / np.maximum(squared, 1e-9))
        rows[:n, 5:] = motion[:, :2] * shrinkage[:, None]
        if own_body and len(ids):
            vx, vy, turn = self._twist
            rows[n, 5:] = -(vx - turn * rows[n, 1]), -(vy + turn * rows[n, 0])

    def at_ego_instant(self, ego_SE2_list: SE2, offset: float, covariance: FloatArray) -> tuple[SE2, FloatArray]:
        """The pose with other's frame at the ego's instant, and its (3, 3) covariance.

        Args:
            ego_SE2_list: with other's frame at the instant of its list.
            offset: time offset of the list [s].
            covariance: (4, 4) of x, y, yaw and the offset.
        """
        shift = self._twist * offset
        half = SE2(0.0, 0.0, 0.5 * shift[2]).rotation @ shift[:2]
        jacobian = np.eye(3, 4)
        jacobian[:2, 3] = ego_SE2_list.rotation @ self._twist[:2]
        jacobian[2, 3] = self._twist[2]
        return ego_SE2_list @ SE2(half[0], half[1], shift[2]), jacobian @ covariance @ jacobian.T


_SHRINKAGE = 4.0
"""A speed below the root of this many variances counts as 0."""
_NO_IDS = np.zeros(0, np.int64)
_NO_IDS.setflags(write=False)  # like the arrays of `Boxes`: numba compiles for one kind of array only


def _bev_rows(boxes: Boxes) -> FloatArray:
    """(N, 7) x, y, length, width, yaw and a velocity of 0, as the kernels take them."""
    rows = np.zeros((len(boxes), 7))
    rows[:, :2] = boxes.center[:, :2]
    rows[:, 2:4] = boxes.size[:, :2]
    rows[:, 4] = boxes.yaw
    return rows


def _nothing_in_common(ego: Boxes, other: Boxes) -> str:
    if len(ego) == 0 or len(other) == 0:
        return f"{'ego' if len(ego) == 0 else 'other'} sees no object"
    return "no two boxes are similar enough to be one object"


def _fit_covariance(arms: FloatArray, position_std: float) -> FloatArray:
    """(3, 3) covariance of a least-squares pose from (2, K) rotated points with independent errors."""
    k = arms.shape[1]
    information = np.diag([float(k), float(k), float((arms**2).sum())])
    information[0, 2] = information[2, 0] = -arms[1].sum()
    information[1, 2] = information[2, 1] = arms[0].sum()
    covariance: FloatArray = np.linalg.pinv(information) * position_std**2
    return covariance


def _load_kernels() -> ModuleType:
    """Import the numba kernels: only here, because numba takes longer to import than everything else together."""
    from cobevglue.alignment import pose_filter

    return pose_filter
