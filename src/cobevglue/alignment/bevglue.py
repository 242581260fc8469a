"""BEVGlue: the relative pose between two agents from the objects both see (paper, section 4)."""

from __future__ import annotations

import math

import numpy as np

from cobevglue.alignment.alignment import Alignment
from cobevglue.alignment.config import BEVGlueConfig
from cobevglue.alignment.evidence_matcher import EvidenceMatcher, ListTimes
from cobevglue.alignment.hypotheses import PoseHypothesis
from cobevglue.alignment.own_body import append_body, check_bodies
from cobevglue.alignment.paper_matcher import PaperMatcher
from cobevglue.boxes import Boxes
from cobevglue.clock import Clock
from cobevglue.se2 import SE2
from cobevglue.typing import ArrayLike, FloatArray

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
        self._matcher: PaperMatcher | EvidenceMatcher = (
            PaperMatcher(self.config) if self.config.method == "affinity" else EvidenceMatcher(self.config)
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
        prior: tuple[SE2, ArrayLike] | None = None,
    ) -> Alignment:
        """The relative pose in this frame, or a refusal with its reason.

        An agent's own vehicle is an object for the other agent, but missing from the agent's own detections. If given,
        it is matched like any box, and a pose that places one vehicle into the other is refused. The paper's method
        uses none of the keyword arguments.

        Args:
            ego: boxes in ego's frame, with track ids if there are any.
            other: the collaborator's boxes in its own frame.
            time: of the ego's boxes [s], on any clock; 0.1 s after the last call by default.
            other_time: the collaborator's own time stamp of its list [s], on the same clock or another one; `time` by
                default. If the two clocks differ by more than a second, only the steps of `other_time` are used.
            ego_body: one-row box of the ego's own vehicle in the ego frame, if it is known.
            other_body: one-row box of the collaborator's own vehicle in its own frame, as it transmits it.
            prior: a claimed ego_SE2_other, from GPS for example, and its (3, 3) covariance of x, y [m] and yaw [rad].
                It is one more pose to try and counts as little evidence, so that a false claim does no harm.

        The list of the collaborator may be of another instant: the offset is estimated from the velocities of its
        tracks, and the pose is that at the ego's instant. The collaborator's frame is moved on if it moves like a
        vehicle or comes with `other_body`; any other frame, such as a map's, is the same at both instants. With
        `BEVGlueConfig(time_offset=False)` the two lists are taken to be of one instant.

        Returns:
            The pose with the matches of `ego` and `other`; matches of own vehicles are not listed.

        Raises:
            ValueError: `time` is not finite, not in seconds or not later than the last call's, a body has not one row,
                or the covariance of the prior is not positive definite.
            TypeError: a list is no `Boxes`.
        """
        for name, boxes in (("ego", ego), ("other", other)):
            if not isinstance(boxes, Boxes):
                raise TypeError(f"{name} must be Boxes, got {type(boxes).__name__}")
        with_bodies = append_body(ego, ego_body, "ego_body"), append_body(other, other_body, "other_body")
        claimed = None if prior is None else (prior[0], _checked_covariance(prior[1]))
        times = self._advance_clocks(time, other_time)
        if isinstance(self._matcher, PaperMatcher):
            return self._matcher.align(ego, other)
        alignment = self._matcher.align(*with_bodies, times, ego_body is not None, other_body is not None, claimed)
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

    def _advance_clocks(self, time: float | None, other_time: float | None) -> ListTimes:
        """Times of these lists; after a gap that is too long everything is forgotten."""
        if other_time is not None and not math.isfinite(other_time):
            raise ValueError(f"other_time must be finite, got {other_time}")
        first = self._clock.time is None
        step = self._clock.advance(time)
        if not first and step > self.config.max_gap:
            self._matcher.reset()
            step = _FRAME
        before, self._other_time = self._other_time, other_time
        if other_time is None:
            return ListTimes(step, step)
        stamp_difference = other_time - (self._clock.time or 0.0)
        return ListTimes(
            step,
            step if before is None else max(other_time - before, 0.0),
            stamp_difference if abs(stamp_difference) <= _SAME_CLOCK else None,
        )


def _checked_covariance(covariance: ArrayLike) -> FloatArray:
    """The (3, 3) covariance of a claimed pose."""
    checked = np.asarray(covariance, dtype=np.float64)
    if checked.shape != (3, 3) or not np.isfinite(checked).all() or np.linalg.eigvalsh(checked).min() <= 0.0:
        raise ValueError(f"prior: the covariance must be (3, 3) and positive definite, got {checked.tolist()}")
    return checked
