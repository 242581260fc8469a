"""What every source of a relative pose returns, and what it looks like from outside."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.se2 import SE2
from cobevglue.typing import FloatArray, IntArray

__all__ = ["Aligner", "Alignment"]


@dataclass(frozen=True, eq=False, slots=True)
class Alignment:
    """The relative pose between two agents, or why there is none.

    Attributes:
        ego_SE2_other: maps the other agent's coordinates into ego's; None when refused.
        matches: (K, 2) rows of ego's and of other's boxes that are one object; empty when refused.
        covariance: (3, 3) of x [m], y [m] and yaw [rad] of `ego_SE2_other`; infinite on the diagonal when refused.
        reason: why the pose was refused, in one sentence; "" when it was accepted.
        evidence: how much speaks for the pose [nats], and
        margin: by how much that exceeds what speaks for the best different pose [nats]; NaN where an aligner
            measures neither.
        risk: estimated probability that the pose lands boxes farther off than the tolerance; also of the best pose
            when refused. NaN where an aligner does not estimate it.
        time_offset: how much later than the ego's boxes the other's list shows the world [s]; -0.1: it is 0.1 s old.
            `ego_SE2_other` has both frames at the ego's instant.
        time_offset_std: its standard deviation [s]; that of the prior where nothing moves, NaN where the offset is not
            estimated.
        ego_SE2_list: the pose of the other's frame at the instant of its list, in the ego frame at the ego's instant:
            by this pose features are warped. None for `ego_SE2_other` itself.
        other_velocity: (N, 2) velocity of the other's boxes in its own, moving frame [m/s]; None for 0.
    """

    ego_SE2_other: SE2 | None
    matches: IntArray = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    covariance: FloatArray = field(default_factory=lambda: np.diag(np.full(3, np.inf)))
    reason: str = ""
    evidence: float = np.nan
    margin: float = np.nan
    risk: float = np.nan
    time_offset: float = 0.0
    time_offset_std: float = np.nan
    ego_SE2_list: SE2 | None = None
    other_velocity: FloatArray | None = None

    @classmethod
    def refused(cls, reason: str, evidence: float = np.nan, margin: float = np.nan, risk: float = np.nan) -> Alignment:
        """No pose, and why."""
        return cls(None, reason=reason, evidence=evidence, margin=margin, risk=risk)

    @property
    def accepted(self) -> bool:
        """Whether there is a pose to use."""
        return self.ego_SE2_other is not None

    def boxes_at_ego_instant(self, other: Boxes) -> Boxes:
        """The other's boxes in the ego frame at the ego's instant: moved by their velocity and the time offset.

        Args:
            other: the N boxes that were aligned, in the other's frame.

        Raises:
            ValueError: the alignment was refused, or `other` has another number of rows.
        """
        if self.ego_SE2_other is None:
            raise ValueError(f"no pose: {self.reason}")
        if self.other_velocity is not None:
            if len(other) != len(self.other_velocity):
                raise ValueError(f"other has {len(other)} boxes, {len(self.other_velocity)} were aligned")
            center = other.center.copy()
            center[:, :2] -= self.time_offset * self.other_velocity
            other = other.replace(center=center)
        return other.transform(self.ego_SE2_other)


class Aligner(Protocol):
    """A source of the relative pose from two agents' boxes. It may remember; one is needed for each collaborator."""

    def align(self, ego: Boxes, other: Boxes, time: float | None = None) -> Alignment:
        """The pose of `other` (its own frame) in `ego`'s frame; `time` [s] defaults to 0.1 s after the last call.

        Where the own vehicle of an agent is known, it is passed as `ego_body` or `other_body`, and the other's own time
        stamp as `other_time` (see `BEVGlue.align`).
        """
        ...

    def reset(self) -> None:
        """Forget everything seen so far."""
        ...
