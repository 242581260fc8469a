"""The robust variant: stars scored by likelihood ratios, hypotheses carried over time, a verdict."""

from __future__ import annotations

import math
from dataclasses import dataclass
from types import ModuleType

import numpy as np

from cobevglue.alignment.alignment import Alignment
from cobevglue.alignment.box_rows import box_rows, track_ids
from cobevglue.alignment.config import BEVGlueConfig
from cobevglue.alignment.frame_motion import FrameMotion
from cobevglue.alignment.hypotheses import PoseHypothesis, from_records
from cobevglue.alignment.verdict import judge
from cobevglue.boxes import Boxes
from cobevglue.se2 import SE2
from cobevglue.typing import FloatArray

__all__ = ["EvidenceMatcher", "ListTimes"]


@dataclass(frozen=True, slots=True)
class ListTimes:
    """Times of one pair of lists [s].

    Attributes:
        ego_step: since the ego's last list.
        other_step: since the other's last list.
        stamp_difference: the other's time stamp minus the ego's, if both are of one clock; otherwise None.
    """

    ego_step: float
    other_step: float
    stamp_difference: float | None = None


class EvidenceMatcher:
    """Follows the hypotheses of one pair of agents from frame to frame."""

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
            config.offset_drift if config.time_offset else 0.0,
            config.absence,
        )
        self._rounds = config.rounds if config.refit else 0
        self.reset()

    def reset(self) -> None:
        """Forget all frames."""
        self._hypotheses = np.zeros(0, self._kernels.HYPOTHESIS)
        self._seen = 0
        self._expected_offset = 0.0
        self._ego_motion, self._other_motion = FrameMotion(), FrameMotion()

    @property
    def hypotheses(self) -> tuple[PoseHypothesis, ...]:
        """The poses that fit the lists of the last call, best first."""
        return from_records(self._hypotheses, self._seen, self._config)

    def align(
        self,
        ego: Boxes,
        other: Boxes,
        times: ListTimes,
        ego_body: bool = False,
        other_body: bool = False,
        prior: tuple[SE2, FloatArray] | None = None,
    ) -> Alignment:
        """The pose of this pair of frames.

        Args:
            ego: in the ego frame.
            other: in the other agent's frame.
            times: of the lists.
            ego_body: whether the last box of `ego` is its own vehicle.
            other_body: likewise of `other`.
            prior: a claimed ego_SE2_other and its (3, 3) covariance.
        """
        config = self._config
        if not config.temporal:
            self.reset()
        ego_rows, other_rows = box_rows(ego), box_rows(other)
        ego_count, other_count = len(ego) - ego_body, len(other) - other_body
        self._ego_motion.velocities(ego_rows[:ego_count], track_ids(ego)[:ego_count], times.ego_step)
        was_vehicle = self._other_motion.is_vehicle
        velocity = self._other_motion.velocities(
            other_rows[:other_count], track_ids(other)[:other_count], times.other_step, other_body
        )
        if self._other_motion.is_vehicle is not was_vehicle:
            self._change_instant()
        if config.time_offset:
            other_rows[:other_count, 5:] = velocity  # the own vehicle does not move in its own frame
        expected_offset, offset_std = 0.0, 0.0
        if config.time_offset:
            stamped = times.stamp_difference is not None
            expected_offset = times.stamp_difference or 0.0
            offset_std = config.stamped_offset_std if stamped else config.offset_std
        claim = np.full((4, 3), np.inf)
        if prior is not None:
            claim[0], claim[1:] = (prior[0].x, prior[0].y, prior[0].yaw), prior[1]
        found = self._kernels.advance(
            self._hypotheses,
            ego_rows,
            other_rows,
            track_ids(ego),
            track_ids(other),
            ego_body and other_body,
            times.ego_step,
            self._ego_motion.twist[2] - self._other_motion.twist[2],
            self._ego_motion.turn_rate_variance + self._other_motion.turn_rate_variance,
            expected_offset,
            expected_offset - self._expected_offset,
            offset_std,
            self._other_motion.is_vehicle,
            claim,
            self._seen,
            self._noise,
            self._motion,
            config.tries,
            self._rounds,
        )
        self._hypotheses, margin, frame_margin, landing_std, pairs, x, y, yaw, offset, covariance = found
        self._seen += 1
        self._expected_offset = expected_offset
        if not len(self._hypotheses):
            return Alignment.refused(_nothing_in_common(ego, other), evidence=0.0, margin=0.0, risk=1.0)
        evidence = float(self._hypotheses[0]["evidence"])
        verdict = judge(evidence, margin, frame_margin, landing_std, len(pairs), self._seen, config)
        if verdict.reason and config.verdict:
            return Alignment.refused(verdict.reason, evidence, margin, verdict.risk)
        pose = SE2(x, y, yaw)
        if not config.time_offset:
            return Alignment(pose, pairs, covariance[:3, :3], "", evidence, margin, verdict.risk)
        return Alignment(
            pose,
            pairs,
            covariance[:3, :3],
            "",
            evidence,
            margin,
            verdict.risk,
            time_offset=offset,
            time_offset_std=math.sqrt(max(covariance[3, 3], 0.0)),
            ego_SE2_list=pose @ self._other_motion.before(-offset) if self._other_motion.is_vehicle else pose,
            other_velocity=velocity,
        )

    def _change_instant(self) -> None:
        """Move the hypotheses to the other list's instant, or back, when its frame becomes or ceases to be a vehicle's.

        A vehicle's frame is another one at the ego's instant; any other frame is the same.
        """
        motion = self._other_motion
        for h in self._hypotheses:
            pivot = np.array([[h["other_x"], h["other_y"]]])
            arm_x, arm_y = SE2(0.0, 0.0, h["yaw"]).apply(pivot)[0]
            pose = SE2(h["ego_x"] - arm_x, h["ego_y"] - arm_y, h["yaw"])
            now_SE2_list = motion.before(-float(h["offset"]))
            moved = pose @ (now_SE2_list.inverse() if motion.is_vehicle else now_SE2_list)
            h["ego_x"], h["ego_y"] = moved.apply(pivot)[0]
            h["yaw"] = moved.yaw


def _nothing_in_common(ego: Boxes, other: Boxes) -> str:
    if len(ego) == 0 or len(other) == 0:
        return f"{'ego' if len(ego) == 0 else 'other'} sees no object"
    return "no two boxes are similar enough to be one object"


def _load_kernels() -> ModuleType:
    """Import the numba kernels: only here, because numba takes longer to import than everything else together."""
    from cobevglue.alignment import pose_filter

    return pose_filter
