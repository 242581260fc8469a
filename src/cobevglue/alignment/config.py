"""Settings of BEVGlue. Every number here is ours: the paper's are in an appendix that is not public.

The noise and motion model of the robust variant were chosen by random search on the V2V4Real `train` detections, moved
along several smooth trajectories; how fast the relative yaw may change also by the simulated junction, where agents
turn. The parameters of the posterior (`absence`, `chance_evidence`, `self_similarity`, `risk`) were chosen on V2V4Real
`train`, on OPV2V labels with lists up to 0.3 s old, and on unrelated agents of `train`; the simulated scenes showed
what was missing. V2V4Real `val` was evaluated twice with these: with `range_tolerance`, and without.

What was not kept apart: while an earlier version took shape (how near a star must be to continue a hypothesis, when a
surprise may overrule it) results on `val` were in view beside those on `train`.
"""

from __future__ import annotations

import math
from typing import Annotated, Literal

from pydantic import Field

from cobevglue.settings import Settings

__all__ = ["AffinityConfig", "BEVGlueConfig"]

_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
_NotNegative = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
_Share = Annotated[float, Field(gt=0.0, lt=1.0)]


class AffinityConfig(Settings):
    """Affinity functions and thresholds of the paper's own matcher (section 4.2), our fill-ins.

    Node affinity is exp(-(dl/length_scale)^2 - (dw/width_scale)^2), edge affinity exp(-(g/position_scale)^2 -
    (h/heading_scale)^2) with g the distance between where the two edges lead and h the difference of their headings.

    Attributes:
        length_scale: of the node affinity [m].
        width_scale: of the node affinity [m].
        position_scale: of the edge affinity [m].
        heading_scale: of the edge affinity [rad].
        node_threshold: gamma_V; a pair of boxes with a lower affinity is never matched.
        edge_threshold: gamma_E; a pair of edges with a lower affinity is never matched.
    """

    length_scale: _Positive = 1.5
    width_scale: _Positive = 0.5
    position_scale: _Positive = 2.0
    heading_scale: _Positive = math.radians(20.0)
    node_threshold: _Share = 0.3
    edge_threshold: _Share = 0.3


class BEVGlueConfig(Settings):
    """Settings of `BEVGlue`. The defaults are the robust variant; `BEVGlueConfig.paper()` follows the text literally.

    Attributes:
        method: "evidence" (ours: stars scored by likelihood ratios, hypotheses carried over time) or "affinity" (the
            paper's). Everything below but `affinity` belongs to "evidence".
        range_tolerance: the tolerance of an edge grows with its length, as far as the heading it hangs on is uncertain.
            Off by default: refits make the yaw certain, and chance pairs gain more from it (docs/benchmarks.md).
        one_to_one: a box belongs to one pair at most.
        heading_flips: headings are compared modulo pi, and every seed is tried turned by pi as well.
        sizes: lengths and widths count as evidence.
        refit: a star is refitted to all its pairs and matched again, instead of keeping its seed's pose.
        temporal: hypotheses are carried from frame to frame; otherwise every frame stands alone.
        tracks: a hypothesis also follows the track pairs it matched before (where both lists have track ids).
        time_offset: every hypothesis has the time offset of other's list as one more unknown (needs other's track ids).
        verdict: doubtful poses are refused; otherwise the best pose is always accepted.
        position_std: of each component of the distance between two agents' detections of one object [m].
        heading_std: of the difference of their headings [rad]; a quarter of them differ several times more.
        length_std: scale of the difference of their lengths [m] (Student t).
        width_std: scale of the difference of their widths [m] (Student t).
        size_gain: evidence of equal sizes [nats].
        density: of boxes that could match by chance [1/m^2].
        flip_probability: that one of two headings is turned by 180 degrees.
        acceleration: process noise of the relative velocity [m/s^2 per sqrt(Hz)].
        yaw_acceleration: process noise of the relative yaw rate [rad/s^2 per sqrt(Hz)].
        speed_std: prior of the relative velocity [m/s].
        yaw_rate_std: prior of the relative yaw rate [rad/s].
        offset_std: prior of the time offset where the lists have no stamps of one clock [s].
        stamped_offset_std: prior of the time offset beyond the difference of the stamps, where they have [s].
        offset_drift: process noise of the time offset [s per sqrt(s)].
        absence: evidence against a pose for each box that lies in the view of the other agent and has no counterpart
            [nats].
        correlation: how many frames in a row share their detection errors: measurements count that much less.
        memory: weight of the evidence so far after 0.1 s.
        miss_memory: the same after 0.1 s in which nothing agreed with the hypothesis.
        link_distance: a star this near to a predicted pose (at its pivot) continues the hypothesis [m].
        link_angle: and this near in yaw [rad].
        chance_evidence: that the best pose of two agents with nothing in common reaches [nats].
        self_similarity: share of the evidence of the best different pose by which the best one has to exceed it before
            it counts as better, so that a long row of equal gaps stays ambiguous.
        tolerance: a pose is wrong if it lands boxes farther off than this [m].
        risk: accept only if the estimated probability of a wrong pose is below this.
        tries: seeds that are refined in each frame.
        rounds: refits of each.
        max_gap: after this time without a call everything is forgotten [s].
        affinity: for the paper's method.

    Raises:
        ValueError: a value out of its range or an unknown field.
    """

    method: Literal["evidence", "affinity"] = "evidence"
    range_tolerance: bool = False
    one_to_one: bool = True
    heading_flips: bool = True
    sizes: bool = True
    refit: bool = True
    temporal: bool = True
    tracks: bool = True
    time_offset: bool = True
    verdict: bool = True

    position_std: _Positive = 0.6
    heading_std: _Positive = math.radians(4.0)
    length_std: _Positive = 1.1
    width_std: _Positive = 0.15
    size_gain: _NotNegative = 0.8
    density: _Positive = 0.004
    flip_probability: _Share = 0.05

    acceleration: _Positive = 4.0
    yaw_acceleration: _Positive = 0.15
    speed_std: _Positive = 15.0
    yaw_rate_std: _Positive = 0.3
    offset_std: _Positive = 0.15
    stamped_offset_std: _Positive = 0.05
    offset_drift: _NotNegative = 0.02
    absence: _NotNegative = 0.7
    correlation: _Positive = 3.0
    memory: _Share = 0.92
    miss_memory: _Share = 0.6
    link_distance: _Positive = 3.0
    link_angle: _Positive = 0.15

    chance_evidence: _NotNegative = 6.0
    self_similarity: _NotNegative = 0.33
    tolerance: _Positive = 3.0
    risk: _Share = 0.05

    tries: Annotated[int, Field(ge=1)] = 6
    rounds: Annotated[int, Field(ge=1)] = 2
    max_gap: _Positive = 2.0

    affinity: AffinityConfig = AffinityConfig()

    @classmethod
    def paper(cls) -> BEVGlueConfig:
        """The paper, literally: star expansion, most nodes wins, ties by Eq. 5, SVD, no verdict."""
        return cls(method="affinity", verdict=False)
