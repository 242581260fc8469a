"""BEVGlue: the relative pose between two agents from the objects both see (paper, section 4)."""

from __future__ import annotations

import math
from types import ModuleType

import numpy as np

from cobevglue.alignment.alignment import Alignment
from cobevglue.alignment.common_subgraph import common_subgraph, surviving_pairs
from cobevglue.alignment.config import BEVGlueConfig
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

    def align(
        self,
        ego: Boxes,
        other: Boxes,
        time: float | None = None,
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
            time: when both were seen [s], on any clock; 0.1 s after the last call by default.
            ego_body: one-row box of the ego's own vehicle in the ego frame, if it is known.
            other_body: one-row box of the collaborator's own vehicle in its own frame, as it transmits it.

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
        alignment = self._matcher.align(*with_bodies, self._advance_clock(time), last_differ=two_vehicles)
        return check_bodies(alignment, ego, other, ego_body, other_body)

    def reset(self) -> None:
        """Forget all frames."""
        self._clock.reset()
        self._matcher.reset()

    def _advance_clock(self, time: float | None) -> float:
        """Seconds since the last call; after a gap that is too long everything is forgotten."""
        first = self._clock.time is None
        step = self._clock.advance(time)
        if not first and step > self.config.max_gap:
            self._matcher.reset()
            return _FRAME
        return step


class _PaperMatcher:
    """The method as printed: graphs, temporally consistent maximum common subgraph, SVD."""

    def __init__(self, config: BEVGlueConfig) -> None:
        self._config = config
        self.reset()

    def reset(self) -> None:
        self._track_pairs: IntArray = np.zeros((0, 2), np.int64)

    def align(self, ego: Boxes, other: Boxes, dt: float, last_differ: bool) -> Alignment:
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
        )
        self._rounds = config.rounds if config.refit else 0
        self.reset()

    def reset(self) -> None:
        self._hypotheses = np.zeros(0, self._kernels.HYPOTHESIS)
        self._seen = 0

    def align(self, ego: Boxes, other: Boxes, dt: float, last_differ: bool) -> Alignment:
        if not self._config.temporal:
            self.reset()
        self._hypotheses, margin, landing_std, pairs, x, y, yaw, covariance = self._kernels.advance(
            self._hypotheses,
            _bev_rows(ego),
            _bev_rows(other),
            _NO_IDS if ego.track_id is None else ego.track_id,
            _NO_IDS if other.track_id is None else other.track_id,
            last_differ,
            dt,
            self._seen,
            self._noise,
            self._motion,
            self._config.tries,
            self._rounds,
        )
        self._seen += 1
        if not len(self._hypotheses):
            return Alignment.refused(_nothing_in_common(ego, other), evidence=0.0, margin=0.0)
        evidence = float(self._hypotheses[0]["evidence"])
        choices = len(ego) * len(other)
        reason = self._doubt(len(pairs), choices, evidence, margin, landing_std) if self._config.verdict else ""
        if reason:
            return Alignment.refused(reason, evidence, margin)
        return Alignment(SE2(x, y, yaw), pairs, covariance, "", evidence, margin)

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


_NO_IDS = np.zeros(0, np.int64)
_NO_IDS.setflags(write=False)  # like the arrays of `Boxes`: numba compiles for one kind of array only


def _bev_rows(boxes: Boxes) -> FloatArray:
    """(N, 5) x, y, length, width, yaw, as the kernels take them (`Boxes.bev`, but without its cost)."""
    rows = np.empty((len(boxes), 5))
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
