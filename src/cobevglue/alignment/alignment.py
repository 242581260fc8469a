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
    """

    ego_SE2_other: SE2 | None
    matches: IntArray = field(default_factory=lambda: np.zeros((0, 2), np.int64))
    covariance: FloatArray = field(default_factory=lambda: np.diag(np.full(3, np.inf)))
    reason: str = ""
    evidence: float = np.nan
    margin: float = np.nan

    @classmethod
    def refused(cls, reason: str, evidence: float = np.nan, margin: float = np.nan) -> Alignment:
        """No pose, and why."""
        return cls(None, reason=reason, evidence=evidence, margin=margin)

    @property
    def accepted(self) -> bool:
        """Whether there is a pose to use."""
        return self.ego_SE2_other is not None


class Aligner(Protocol):
    """A source of the relative pose from two agents' boxes. It may remember; one is needed for each collaborator."""

    def align(self, ego: Boxes, other: Boxes, time: float | None = None) -> Alignment:
        """The pose of `other` (its own frame) in `ego`'s frame; `time` [s] defaults to 0.1 s after the last call.

        Where the own vehicle of an agent is known, it is passed as `ego_body` or `other_body` (see `BEVGlue.align`).
        """
        ...

    def reset(self) -> None:
        """Forget everything seen so far."""
        ...
