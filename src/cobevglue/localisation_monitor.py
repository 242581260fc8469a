"""Integrity monitoring of claimed poses: are GNSS poses consistent with the agents' objects?

    monitor = LocalisationMonitor()
    report = monitor.update(time, claimed, alignments, ego="car1")
    report.alarm            # a claimed pose is false
    report.faulty           # whose, if it can be attributed
    report.prior("car2")    # the claimed relative pose with its covariance for `BEVGlue.align`, or None

For every pair of agents, the difference of the claimed and the aligned relative pose goes through a Kalman filter. Its
state is the error of the claims, and honest errors are first-order Gauss-Markov processes: as large as the claimed
covariance, and correlated over `correlation_time`, as GNSS errors are. Two sequential tests find false claims:

- *jump*: a CUSUM of the normalised innovations squared (Page, "Continuous Inspection Schemes", 1954). The
  increment of a frame is bounded, so that a single wrong alignment cannot raise the alarm;
- *offset*: the error by the filter, in standard deviations of the claim. It finds slow drifts.

Agents at fault are the smallest set without which all pairs agree, if there is one such set and it is a minority.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from pydantic import Field

from cobevglue.alignment.alignment import Alignment
from cobevglue.alignment.uncertain_poses import relative, to_se2, to_xyyaw
from cobevglue.clock import Clock
from cobevglue.datasets.frame import did_you_mean
from cobevglue.se2 import SE2, wrap_angle
from cobevglue.settings import Settings
from cobevglue.typing import ArrayLike, FloatArray

__all__ = ["LocalisationMonitor", "LocalisationMonitorConfig", "LocalisationReport", "PairTest"]

_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
_Spread = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]

_FRAME = 0.1
"""Time between frames when none is given, and what the CUSUM counts in [s]."""

Pair = tuple[str, str]


class LocalisationMonitorConfig(Settings):
    """Settings of `LocalisationMonitor`; how they were chosen: docs/trust.md.

    Attributes:
        correlation_time: of honest localisation errors [s].
        white_position_std: the part of an honest error that is new in each frame, of x and of y [m].
        white_yaw_std: and of yaw [rad].
        alignment_position_std: errors of alignments that their covariance does not have, of x and of y [m].
        alignment_yaw_std: and of yaw [rad].
        alignment_bias_std: the part of them that stays for a long time, of x and of y [m].
        risk: alignments of a higher stated risk are not used.
        margin: nor are those of which the margin is a smaller share of the evidence: where a different pose has half as
            much evidence, as among rows of parked cars, the alignment may be wrong and the claim right.
        innovation: innovations squared (normalised, 3 degrees of freedom) above this speak for a jump.
        jump_time: so long they have to exceed it clearly, net of the time they do not [s].
        offset: alarm when the position error exceeds this many standard deviations of the claim.
        clear_offset: and until it is below so many again.
        max_gap: a pair that was not aligned for so long starts anew, without its alarm [s].
    """

    correlation_time: _Positive = 60.0
    white_position_std: _Spread = 0.2
    white_yaw_std: _Spread = math.radians(0.2)
    alignment_position_std: _Spread = 0.5
    alignment_yaw_std: _Spread = math.radians(3.0)
    alignment_bias_std: _Spread = 0.3
    risk: Annotated[float, Field(gt=0.0, le=1.0)] = 0.05
    margin: Annotated[float, Field(ge=0.0, le=1.0)] = 0.55
    innovation: _Positive = 16.0
    jump_time: _Positive = 0.5
    offset: _Positive = 4.5
    clear_offset: _Positive = 3.5
    max_gap: _Positive = 10.0


@dataclass(frozen=True, slots=True, eq=False)
class PairTest:
    """The tests of the claims of one pair of agents.

    Attributes:
        offset: (2,) how far the claimed position of the second agent relative to the first is off, by the filter: x and
            y in the frame of the claims [m]; after a jump, what it was before.
        deviations: the same in standard deviations of the claims.
        jump: the CUSUM of the innovations as a share of its threshold: 1 is an alarm.
        reason: "jump", "offset" or "jump and offset"; "" if the claims are consistent with the alignments.
    """

    offset: FloatArray
    deviations: float
    jump: float
    reason: str

    @property
    def consistent(self) -> bool:
        """Whether no test has raised an alarm."""
        return not self.reason


@dataclass(frozen=True, slots=True, eq=False)
class LocalisationReport:
    """What the monitor says in one frame.

    Attributes:
        time: of the frame [s].
        ego: name of the ego.
        pairs: the test of every pair that could be tested, in this frame or within `max_gap` before.
        faulty: agents whose claims are false. Empty if they cannot be attributed, as for two agents.
        claims: by agent, (3,) of the claimed world_SE2_agent and its (3, 3) covariance.
    """

    time: float
    ego: str
    pairs: dict[Pair, PairTest]
    faulty: frozenset[str]
    claims: dict[str, tuple[FloatArray, FloatArray]] = field(repr=False)

    @property
    def alarm(self) -> bool:
        """Whether the claims of any pair are inconsistent with its alignment."""
        return any(not test.consistent for test in self.pairs.values())

    @property
    def unresolved(self) -> list[Pair]:
        """Inconsistent pairs of which it is not known which of the two is at fault."""
        return [pair for pair, test in self.pairs.items() if not test.consistent and not self.faulty & set(pair)]

    def prior(self, other: str) -> tuple[SE2, FloatArray] | None:
        """The claimed ego_SE2_other and its covariance, for `BEVGlue.align(prior=...)`.

        None without claims, before the pair was tested, or if the claims are inconsistent.
        """
        test = self.pairs.get((self.ego, other))
        if test is None or not test.consistent or {self.ego, other} & self.faulty or other not in self.claims:
            return None
        pose, covariance = relative(*self.claims[self.ego], *self.claims[other])
        return to_se2(pose), covariance


class LocalisationMonitor:
    """Tests the claimed poses of all agents against their alignments. One for each ego."""

    def __init__(self, config: LocalisationMonitorConfig | None = None) -> None:
        """Start with nothing seen."""
        self.config = config or LocalisationMonitorConfig()
        self._clock = Clock(_FRAME)
        self._pairs: dict[Pair, _PairFilter] = {}
        self._ego: str | None = None

    def update(
        self,
        time: float | None,
        claimed: Mapping[str, tuple[SE2, ArrayLike]],
        alignments: Mapping[str, Alignment],
        ego: str,
    ) -> LocalisationReport:
        """The next frame.

        Args:
            time: of the frame [s]; None for 0.1 s after the last.
            claimed: world_SE2_agent of every agent that claims one, the ego among them, and its (3, 3) covariance of x,
                y [m] and yaw [rad].
            alignments: of the other agents with the ego. Refused ones and agents without a claim are left out.
            ego: its name; with another ego than in the last frame, the monitor starts anew.

        Raises:
            ValueError: the ego claims no pose, a covariance is not (3, 3) and positive definite (names the agent), or
                `time` is not later than the last.
        """
        if ego not in claimed:
            raise ValueError(f"claimed: there is no agent {did_you_mean(ego, claimed)}")
        claims = {agent: (to_xyyaw(pose), _checked(agent, covariance)) for agent, (pose, covariance) in claimed.items()}
        self._clock.advance(time)
        assert self._clock.time is not None
        now = self._clock.time
        if ego != self._ego:
            self._pairs.clear()
            self._ego = ego
        for (a, b), (a_SE2_b, covariance) in self._measured(ego, claims, alignments).items():
            known = self._pairs.get((a, b))
            if known is None or now - known.time > self.config.max_gap:
                known = self._pairs[a, b] = _PairFilter(self.config, now)
            known.update(now, *claims[a], *claims[b], a_SE2_b, covariance)
        self._pairs = {pair: known for pair, known in self._pairs.items() if now - known.time <= self.config.max_gap}
        tests = {pair: known.test() for pair, known in self._pairs.items()}
        return LocalisationReport(now, ego, tests, faulty_agents(tests), claims)

    def uses(self, alignment: Alignment) -> bool:
        """Whether an alignment is certain enough to test a claim; not measured (NaN) counts as certain."""
        low = alignment.margin < self.config.margin * alignment.evidence
        return alignment.accepted and not (low or alignment.risk > self.config.risk)

    def reset(self) -> None:
        """Forget all frames and alarms."""
        self._clock.reset()
        self._pairs.clear()
        self._ego = None

    def _measured(
        self, ego: str, claims: Mapping[str, tuple[FloatArray, FloatArray]], alignments: Mapping[str, Alignment]
    ) -> dict[Pair, tuple[FloatArray, FloatArray]]:
        """a_SE2_b and its covariance of all pairs (a, b): of the ego and another, and of two others through the ego."""
        found = {
            agent: (to_xyyaw(alignment.ego_SE2_other), alignment.covariance)
            for agent, alignment in alignments.items()
            if agent in claims
            and alignment.ego_SE2_other is not None
            and np.isfinite(alignment.covariance).all()
            and self.uses(alignment)
        }
        measured = {(ego, agent): pose for agent, pose in found.items()}
        for a, b in itertools.combinations(sorted(found), 2):
            measured[a, b] = relative(*found[a], *found[b])
        return measured


class _PairFilter:
    """Kalman filter of the claims' errors of agents a and b, and the two tests.

    The state is claimed minus true: the position of b relative to a in the world (2), the yaw of a, the yaw of b.
    """

    def __init__(self, config: LocalisationMonitorConfig, time: float) -> None:
        self.config = config
        self.time = time
        self.state = np.zeros(4)
        self.covariance: FloatArray | None = None
        self.cusum = 0.0
        self.jumped = self.off = False
        self.deviations = 0.0

    def update(
        self,
        time: float,
        a_claim: FloatArray,
        a_covariance: FloatArray,
        b_claim: FloatArray,
        b_covariance: FloatArray,
        a_SE2_b: FloatArray,
        covariance: FloatArray,
    ) -> None:
        """Compare claims of world_SE2_a and world_SE2_b with a measured a_SE2_b."""
        config, step = self.config, time - self.time
        self.time = time
        prior = np.zeros((4, 4))
        prior[:2, :2] = a_covariance[:2, :2] + b_covariance[:2, :2]
        prior[:2, 2], prior[:2, 3] = -a_covariance[:2, 2], b_covariance[:2, 2]
        prior[2:, :2] = prior[:2, 2:].T
        prior[2, 2], prior[3, 3] = a_covariance[2, 2], b_covariance[2, 2]
        if self.covariance is None:
            self.covariance = prior
        elif not self.jumped:  # after a jump, the state stays what it was before, to see the claim come back
            kept = math.exp(-step / config.correlation_time)
            self.state = kept * self.state
            self.covariance = kept**2 * self.covariance + (1.0 - kept**2) * prior

        cos, sin = math.cos(a_claim[2]), math.sin(a_claim[2])
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        aligned = turn @ a_SE2_b
        residual = b_claim - a_claim - aligned
        residual[2] = wrap_angle(residual[2])
        # A yaw error of a turns what is aligned about a.
        design = np.array([[1.0, 0.0, aligned[1], 0.0], [0.0, 1.0, -aligned[0], 0.0], [0.0, 0.0, -1.0, 1.0]])
        noise = turn @ covariance @ turn.T
        position = config.alignment_position_std**2 + 2.0 * config.white_position_std**2
        noise[[0, 1, 2], [0, 1, 2]] += position, position, config.alignment_yaw_std**2 + 2.0 * config.white_yaw_std**2
        innovation = residual - design @ self.state
        total = design @ self.covariance @ design.T + noise
        gain = np.linalg.solve(total, design @ self.covariance).T
        squared = float(innovation @ np.linalg.solve(total, innovation))
        if squared < config.innovation:  # what looks like a jump is no information about the error before it
            self.state = self.state + gain @ innovation
            self.covariance = self.covariance - gain @ design @ self.covariance
        self._test_jump(squared, step)
        self._test_offset(prior[:2, :2])

    def _test_jump(self, squared: float, step: float) -> None:
        """A frame counts at most as long as it lasts, and at most 0.1 s."""
        weight = min(step, _FRAME) if step > 0.0 else _FRAME
        self.cusum += weight * min(max(squared / self.config.innovation - 1.0, -1.0), 1.0)
        self.cusum = min(max(self.cusum, 0.0), 2.0 * self.config.jump_time)
        self.jumped = self.cusum > 0.0 and (self.jumped or self.cusum > self.config.jump_time - 1e-9)

    def _test_offset(self, claimed: FloatArray) -> None:
        spread = claimed + self.config.alignment_bias_std**2 * np.eye(2)
        self.deviations = math.sqrt(self.state[:2] @ np.linalg.solve(spread, self.state[:2]))
        self.off = self.deviations > (self.config.clear_offset if self.off else self.config.offset)

    def test(self) -> PairTest:
        """The present result."""
        reasons = [name for name, raised in (("jump", self.jumped), ("offset", self.off)) if raised]
        jump = self.cusum / self.config.jump_time
        return PairTest(self.state[:2].copy(), self.deviations, jump, " and ".join(reasons))


def faulty_agents(tests: Mapping[Pair, PairTest]) -> frozenset[str]:
    """The smallest set of agents without which all pairs are consistent, if it is the only one and a minority."""
    agents = sorted({agent for pair in tests for agent in pair})
    bad = [set(pair) for pair, test in tests.items() if not test.consistent]
    suspects = sorted(set().union(*bad)) if bad else []
    for size in range(1, (len(agents) - 1) // 2 + 1):
        sets = list(_covering(suspects, bad, size))
        if sets:
            return sets[0] if len(sets) == 1 else frozenset()
    return frozenset()


def _covering(agents: Iterable[str], pairs: list[set[str]], size: int) -> Iterable[frozenset[str]]:
    """The sets of so many agents of which each pair has one."""
    if not pairs:
        return ()
    chosen = (frozenset(some) for some in itertools.combinations(agents, size))
    return (some for some in chosen if all(some & pair for pair in pairs))


def _checked(agent: str, covariance: ArrayLike) -> FloatArray:
    checked = np.asarray(covariance, dtype=np.float64)
    if checked.shape != (3, 3) or not np.isfinite(checked).all() or np.linalg.eigvalsh(checked).min() <= 0.0:
        raise ValueError(
            f"claimed: {agent}: the covariance must be (3, 3) and positive definite, got {checked.tolist()}"
        )
    return checked
