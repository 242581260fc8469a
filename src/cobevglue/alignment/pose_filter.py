"""Relative-pose hypotheses carried over time (numba kernels).

A single frame with two common objects rarely has one answer; a second of frames nearly always has. So the filter
keeps several hypotheses at once, each a relative pose with its rate of change (Kalman filter, constant velocity at
the pivot), the time offset of the other agent's lists, and the evidence it has gathered. In every frame each
hypothesis looks for its common subgraph anew, from where motion and the surviving track pairs say it should be, and
the full `search` runs beside them, so that a wrong lock is left as soon as another pose explains the frames better.

The evidence of a hypothesis is a running mean of its stars' evidence, old frames counting less. It starts as if one
frame without any evidence had been seen before: the first frame alone counts half.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cobevglue._kernels import kernel
from cobevglue.alignment.absence import missing_counterparts
from cobevglue.alignment.evidence import NoiseModel, X, Y, size_evidence, wrap
from cobevglue.alignment.pose_search import (
    SAME_ANGLE,
    SAME_DISTANCE,
    STAR,
    add_star,
    copy_pairs,
    fit_pose,
    most_pairs,
    refine,
    same_pose,
    search,
)

__all__ = ["HYPOTHESIS", "Motion", "NoiseModel", "advance"]

_MOST_TRACK_PAIRS = 16
"""Track pairs a hypothesis remembers."""
_MOST_HYPOTHESES = 6
_FORGOTTEN = 0.3
"""A hypothesis that nothing agreed with is dropped below this evidence [nats]."""
_SURPRISE = 2.0
"""Mean squared innovation, in standard deviations, above which a hypothesis' covariance is inflated."""
_FEWEST_TO_OVERRULE = 4
"""Pairs that it takes for that."""
_SAME_TURN_RATE = 9.0
"""Squared difference of two estimates of a turn rate, in variances, above which one of them is wrong."""
_IMPOSSIBLE = 1e6
"""Evidence against a pair that cannot be one object [nats]."""
_UNSEEN_ACCELERATION, _UNSEEN_TURN_ACCELERATION = 3.0, 0.35
"""Of the other vehicle, between its list and ego's instant, beyond its motion at the list's [m/s^2, rad/s^2]."""
_CLAIM_EVIDENCE = 2.0
"""Evidence of a claimed pose at most [nats]."""
_STEP = 0.1
"""Memory is configured per frame of this length [s]."""

HYPOTHESIS = np.dtype(
    [
        ("ego_x", "f8"),  # the pivot in ego's frame [m] ...
        ("ego_y", "f8"),
        ("other_x", "f8"),  # ... and in other's
        ("other_y", "f8"),
        ("yaw", "f8"),
        ("rate", "f8", (3,)),  # of ego_x, ego_y, yaw, with the pivot held still in other's frame [m/s, rad/s]
        ("offset", "f8"),  # how much later other's list shows the world than ego's [s]
        ("cov", "f8", (7, 7)),  # of (ego_x, ego_y, yaw, rate, offset)
        ("evidence", "f8"),  # running mean [nats]
        ("frame_evidence", "f8"),  # this frame's [nats], 0 when nothing agreed
        ("frames", "i8"),  # frames in which something agreed
        ("pairs", "i8"),  # matched pairs in this frame
        ("tracked_pairs", "i8"),  # how many of the last matched pairs have track ids, and those ids
        ("ego_id", "i8", (_MOST_TRACK_PAIRS,)),
        ("other_id", "i8", (_MOST_TRACK_PAIRS,)),
    ],
    align=True,
)


class Motion(NamedTuple):
    """What the filter assumes of time; see `BEVGlueConfig` for meanings, units and measurements."""

    acceleration: float
    yaw_acceleration: float
    speed_std: float
    yaw_rate_std: float
    correlation: float
    memory: float
    miss_memory: float
    link_distance: float
    link_angle: float
    use_tracks: bool
    offset_drift: float
    absence: float


@kernel(error_model="numpy")
def _mix(cov, i: int, k: int, factor: float) -> None:
    """What adding `factor` times component k to component i of the state does to its covariance."""
    for j in range(7):
        cov[i, j] += factor * cov[k, j]
    for j in range(7):
        cov[j, i] += factor * cov[j, k]


@kernel(error_model="numpy")
def _symmetrise(cov) -> None:
    """Remove what rounding leaves, which would grow from frame to frame."""
    for i in range(7):
        for j in range(i):
            cov[i, j] = cov[j, i] = 0.5 * (cov[i, j] + cov[j, i])


@kernel(error_model="numpy")
def _predict(h, dt: float, motion: Motion) -> None:
    """Constant-twist step of the Kalman filter: the velocity turns with the relative yaw.

    When either agent drives a circle, so does every point of its frame in the other's.
    """
    cos, sin = math.cos(h.rate[2] * dt), math.sin(h.rate[2] * dt)
    vx, vy = h.rate[0], h.rate[1]
    h.rate[0], h.rate[1] = cos * vx - sin * vy, sin * vx + cos * vy
    h.ego_x += 0.5 * (vx + h.rate[0]) * dt
    h.ego_y += 0.5 * (vy + h.rate[1]) * dt
    h.yaw = wrap(h.yaw + h.rate[2] * dt)
    for i in range(3):
        _mix(h.cov, i, i + 3, dt)
    _mix(h.cov, 0, 5, -0.5 * vy * dt * dt)
    _mix(h.cov, 1, 5, 0.5 * vx * dt * dt)
    _mix(h.cov, 3, 5, -vy * dt)
    _mix(h.cov, 4, 5, vx * dt)
    for i in range(3):
        q = (motion.acceleration if i < 2 else motion.yaw_acceleration) ** 2
        h.cov[i, i] += q * dt**3 / 3.0
        h.cov[i, i + 3] += q * dt**2 / 2.0
        h.cov[i + 3, i] += q * dt**2 / 2.0
        h.cov[i + 3, i + 3] += q * dt
    h.cov[6, 6] += motion.offset_drift**2 * dt


@kernel(error_model="numpy")
def _subtract_measured(cov, row, total, measures_offset) -> None:
    """Covariance after a measurement of variance `total`, whose covariance with the state is `row` (7,).

    Velocities are noisy, so positions and rates must not pull at the offset: unless it is what is measured, it is a
    consider state (Schmidt-Kalman), whose variance stays.
    """
    for j in range(7):
        for k in range(7):
            if measures_offset or j < 6 or k < 6:
                cov[j, k] -= row[j] / total * row[k]


@kernel(error_model="numpy")
def _change_pose(h, change) -> None:
    """Add a change (6,) to pose and rate."""
    h.ego_x += change[0]
    h.ego_y += change[1]
    h.yaw = wrap(h.yaw + change[2])
    for j in range(3):
        h.rate[j] += change[3 + j]


@kernel(error_model="numpy")
def _correct_turn_rate(h, turn_rate, variance, is_vehicle) -> None:
    """Kalman update with the relative turn rate that the two frames' motions imply, unless it contradicts the pose's.

    The velocities of the frames are not used: where most of what an agent sees drives along with it, the two agents
    may take different things for the ground.
    """
    total = h.cov[5, 5] + variance
    if is_vehicle:
        total += (_UNSEEN_TURN_ACCELERATION * h.offset) ** 2
    innovation = turn_rate - h.rate[2]
    if innovation * innovation > _SAME_TURN_RATE * total:
        return
    row = np.empty(7)
    for j in range(7):
        row[j] = h.cov[5, j]
    _subtract_measured(h.cov, row, total, False)
    _symmetrise(h.cov)
    change = np.empty(6)
    for j in range(6):
        change[j] = innovation / total * row[j]
    _change_pose(h, change)


@kernel(error_model="numpy")
def _move_pivot(h, other_x: float, other_y: float) -> None:
    """Write the same pose, rate and covariance down at another point of other's frame."""
    cos, sin = math.cos(h.yaw), math.sin(h.yaw)
    dx, dy = other_x - h.other_x, other_y - h.other_y
    x, y = cos * dx - sin * dy, sin * dx + cos * dy
    h.ego_x += x
    h.ego_y += y
    h.other_x, h.other_y = other_x, other_y
    h.rate[0] -= h.rate[2] * y
    h.rate[1] += h.rate[2] * x
    for i in (0, 3):
        _mix(h.cov, i, i // 3 * 3 + 2, -y)
        _mix(h.cov, i + 1, i // 3 * 3 + 2, x)


@kernel(error_model="numpy")
def _correct(h, star, correlation) -> None:
    """Kalman update with a refitted star: four independent measurements, one after another.

    The offset from the differences of velocities, then x, y and yaw at the pivot, each as a linear function of itself
    and the offset.
    """
    _move_pivot(h, star.other_x, star.other_y)
    cos, sin = math.cos(h.yaw), math.sin(h.yaw)
    cov, row = h.cov, np.empty(7)
    innovation, variance, per_offset = np.empty(4), np.empty(4), np.empty(4)
    ahead = star.offset - h.offset
    per_offset[0] = -(cos * star.other_vx - sin * star.other_vy)
    per_offset[1] = -(sin * star.other_vx + cos * star.other_vy)
    per_offset[2] = star.yaw_per_offset
    per_offset[3] = 0.0
    innovation[0] = star.ego_x - h.ego_x + per_offset[0] * ahead
    innovation[1] = star.ego_y - h.ego_y + per_offset[1] * ahead
    innovation[2] = wrap(star.yaw - h.yaw + per_offset[2] * ahead)
    innovation[3] = star.measured_offset - h.offset
    variance[0] = variance[1] = star.position_variance * correlation
    variance[2] = (star.yaw_variance - star.yaw_per_offset**2 * star.offset_variance) * correlation
    variance[3] = star.measured_offset_variance * correlation
    surprise = 0.0
    for i in range(3):
        surprise += innovation[i] ** 2 / (cov[i, i] + variance[i]) / 3.0
    if surprise > _SURPRISE and star.pairs >= _FEWEST_TO_OVERRULE:
        # The motion model is wrong at the moment (braking, steering): trust the measurement. Of two or three pairs one
        # may be a coincidence, which must not rotate a pose that was right.
        for i in range(6):
            for j in range(6):
                cov[i, j] *= surprise / _SURPRISE
        for i in range(6):
            cov[i, 6] *= math.sqrt(surprise / _SURPRISE)
            cov[6, i] = cov[i, 6]
    change = np.zeros(7)
    for i in (3, 0, 1, 2):
        if i == 3 and not (cov[6, 6] > 0.0 and variance[3] < np.inf):
            continue
        state = 6 if i == 3 else i
        left = innovation[i] - change[state] - per_offset[i] * change[6]
        for j in range(7):
            row[j] = cov[state, j] + per_offset[i] * cov[6, j]
        total = row[state] + per_offset[i] * row[6] + variance[i]
        for j in range(7):
            if i == 3 or j < 6:
                change[j] += row[j] / total * left
        _subtract_measured(cov, row, total, i == 3)
    _symmetrise(cov)
    _change_pose(h, change)
    h.offset += change[6]


@kernel(error_model="numpy")
def _start(h, star, motion) -> None:
    """Begin anew at a refitted star's pose; nothing is known of its rate."""
    h.ego_x, h.ego_y, h.other_x, h.other_y = star.ego_x, star.ego_y, star.other_x, star.other_y
    h.yaw = wrap(star.yaw)
    for i in range(7):
        for j in range(7):
            h.cov[i, j] = 0.0
    for i in range(3):
        h.rate[i] = 0.0
    for i in range(2):
        h.cov[i, i] = star.position_variance * motion.correlation
        h.cov[i + 3, i + 3] = motion.speed_std**2
    h.cov[2, 2] = star.yaw_variance * motion.correlation
    h.cov[5, 5] = motion.yaw_rate_std**2
    h.offset, h.cov[6, 6] = star.offset, star.offset_variance
    # Where the offset is wrong, so is the pose: x = x0 + R v (offset - offset0).
    cos, sin = math.cos(h.yaw), math.sin(h.yaw)
    _mix(h.cov, 0, 6, cos * star.other_vx - sin * star.other_vy)
    _mix(h.cov, 1, 6, sin * star.other_vx + cos * star.other_vy)


@kernel(error_model="numpy")
def _set_offset(h, star) -> None:
    """Give a star the time offset of a hypothesis as prior, and the dependence of the pose on it."""
    star.offset = star.prior_offset = h.offset
    star.offset_variance = star.prior_offset_variance = h.cov[6, 6]
    star.other_vx = star.other_vy = 0.0
    if h.cov[6, 6] > 0.0:
        x, y = h.cov[0, 6] / h.cov[6, 6], h.cov[1, 6] / h.cov[6, 6]
        cos, sin = math.cos(h.yaw), math.sin(h.yaw)
        star.other_vx, star.other_vy = cos * x + sin * y, cos * y - sin * x
        star.position_variance = max(0.0, star.position_variance - 0.5 * (x * x + y * y) * h.cov[6, 6])


@kernel(error_model="numpy")
def _follow(h, ego, other, sizes, star, pairs, noise, rounds) -> None:
    """The star a predicted hypothesis finds where its motion says it should be."""
    star.ego_x, star.ego_y, star.other_x, star.other_y, star.yaw = h.ego_x, h.ego_y, h.other_x, h.other_y, h.yaw
    star.position_variance = 0.5 * (h.cov[0, 0] + h.cov[1, 1])
    star.yaw_variance = h.cov[2, 2]
    _set_offset(h, star)
    refine(ego, other, sizes, star, pairs, noise, rounds)


@kernel(error_model="numpy")
def _surviving_pairs(h, ego_ids, other_ids, pairs) -> int:
    """Write the rows of the track pairs matched last time that both agents still track; returns their number."""
    count = 0
    for k in range(h.tracked_pairs):
        for m in range(len(ego_ids)):
            if ego_ids[m] == h.ego_id[k]:
                for n in range(len(other_ids)):
                    if other_ids[n] == h.other_id[k] and count < len(pairs):
                        pairs[count, 0] = m
                        pairs[count, 1] = n
                        count += 1
    return count


@kernel(error_model="numpy")
def _remember(h, star, pairs, ego_ids, other_ids) -> None:
    """Keep the star's evidence and the track ids of its best pairs."""
    h.frame_evidence = star.evidence
    h.frames += 1
    h.pairs = star.pairs
    h.tracked_pairs = min(star.pairs, _MOST_TRACK_PAIRS) if len(ego_ids) and len(other_ids) else 0
    for k in range(h.tracked_pairs):
        h.ego_id[k] = ego_ids[pairs[k, 0]]
        h.other_id[k] = other_ids[pairs[k, 1]]


@kernel(error_model="numpy")
def _unseen_motion(h, is_vehicle):
    """Variances of position and yaw from what other's vehicle did since its list and its tracks do not show."""
    change = 0.25 * h.offset**4 if is_vehicle else 0.0
    return _UNSEEN_ACCELERATION**2 * change, _UNSEEN_TURN_ACCELERATION**2 * change


@kernel(error_model="numpy")
def _at_origin(h, is_vehicle):
    """x, y, yaw and the (4, 4) covariance of them and the offset, at the origin of other's frame."""
    cos, sin = math.cos(h.yaw), math.sin(h.yaw)
    rx, ry = cos * h.other_x - sin * h.other_y, sin * h.other_x + cos * h.other_y
    covariance = np.empty((4, 4))
    for i in range(4):
        for j in range(4):
            covariance[i, j] = h.cov[i if i < 3 else 6, j if j < 3 else 6]
    for i, factor in ((0, ry), (1, -rx)):
        for j in range(4):
            covariance[i, j] += factor * covariance[2, j]
        for j in range(4):
            covariance[j, i] += factor * covariance[j, 2]
    shift, turn = _unseen_motion(h, is_vehicle)
    covariance[0, 0] += shift
    covariance[1, 1] += shift
    covariance[2, 2] += turn
    return h.ego_x - rx, h.ego_y - ry, h.yaw, covariance


@kernel(error_model="numpy")
def _landing_std(h, other, is_vehicle) -> float:
    """Mean over other's boxes of the standard deviation of where they land in ego's frame [m]."""
    total = 0.0
    shift, turn = _unseen_motion(h, is_vehicle)
    for n in range(len(other)):
        squared_arm = (other[n, X] - h.other_x) ** 2 + (other[n, Y] - h.other_y) ** 2
        unseen = 2.0 * shift + turn * (other[n, X] ** 2 + other[n, Y] ** 2)
        total += math.sqrt(h.cov[0, 0] + h.cov[1, 1] + h.cov[2, 2] * squared_arm + unseen)
    return total / len(other) if len(other) else np.inf


@kernel(error_model="numpy")
def _claimed_at(claim, other_x, other_y):
    """A claim pose and its variances at a pivot: ego x, y [m], variance of each [m^2], yaw variance [rad^2]."""
    cos, sin = math.cos(claim[0, 2]), math.sin(claim[0, 2])
    rx, ry = cos * other_x - sin * other_y, sin * other_x + cos * other_y
    variance = claim[1, 0] + claim[2, 1] + 2.0 * (rx * claim[2, 2] - ry * claim[1, 2])
    variance += (rx * rx + ry * ry) * claim[3, 2]
    return claim[0, 0] + rx, claim[0, 1] + ry, 0.5 * variance, claim[3, 2]


@kernel(error_model="numpy")
def _claim_evidence(h, claim) -> float:
    """Evidence of a claim pose for a hypothesis [nats]: it may be false, so it never decides."""
    x, y, variance, yaw_variance = _claimed_at(claim, h.other_x, h.other_y)
    surprise = ((x - h.ego_x) ** 2 + (y - h.ego_y) ** 2) / (variance + 0.5 * (h.cov[0, 0] + h.cov[1, 1]))
    surprise += wrap(claim[0, 2] - h.yaw) ** 2 / (yaw_variance + h.cov[2, 2])
    return _CLAIM_EVIDENCE * math.exp(-0.5 * surprise)


@kernel(error_model="numpy")
def _try_claim(ego, other, sizes, star, pairs, claim, expected_offset, offset_std, noise, rounds) -> None:
    """The star that starts from a claim pose."""
    x = y = 0.0
    for n in range(len(other)):
        x += other[n, X] / len(other)
        y += other[n, Y] / len(other)
    star.other_x, star.other_y, star.yaw = x, y, claim[0, 2]
    star.ego_x, star.ego_y, star.position_variance, star.yaw_variance = _claimed_at(claim, x, y)
    star.offset = star.prior_offset = expected_offset
    star.offset_variance = star.prior_offset_variance = offset_std**2
    star.other_vx = star.other_vy = 0.0
    refine(ego, other, sizes, star, pairs, noise, rounds)


@kernel(error_model="numpy")
def advance(
    old,
    ego,
    other,
    ego_ids,
    other_ids,
    last_differ,
    dt,
    turn_rate,
    turn_rate_variance,
    expected_offset,
    offset_step,
    offset_std,
    is_vehicle,
    claim,
    seen,
    noise,
    motion,
    tries,
    rounds,
):
    """One frame: predict, follow, search, link, update.

    Args:
        old: (H,) `HYPOTHESIS` records of the last frame, best first; overwritten.
        ego: (M, 5) boxes.
        other: (N, 7) boxes.
        ego_ids: (M,) track ids, or (0,) when there are none.
        other_ids: (N,) likewise.
        last_differ: whether the last boxes of both are known to be different objects, the agents' own vehicles.
        dt: seconds since the last frame.
        turn_rate: of other's frame against ego's, from the motions of both frames [rad/s].
        turn_rate_variance: its variance, infinite if unknown.
        expected_offset: prior of the time offset, from the time expected_offset if there are any [s].
        offset_step: how much the expected offset changed since the last frame [s].
        offset_std: standard deviation of the prior; 0 for a known offset [s].
        is_vehicle: whether other's frame is that of a moving vehicle.
        claim: (4, 3) x, y, yaw of a claimed pose and its covariance; infinite without a claim.
        seen: frames seen before this one.
        noise: the noise model.
        motion: the motion model.
        tries: seeds the search refines.
        rounds: refits of each star.

    Returns:
        The hypotheses, best first; how far the best one's evidence exceeds the best different pose's [nats]; the same
        of the evidence of this frame alone, infinite without a different pose; the standard deviation with which the
        best one lands other's boxes in ego's frame, on average [m]; the (K, 2) rows of ego and other that it matches
        in this frame; its x, y and yaw at the ego's instant and the time offset, and the (4, 4) covariance of these
        four.
    """
    steps = dt / _STEP
    memory = min(motion.memory**steps, (seen + 1.0) / (seen + 2.0))
    miss_memory = min(memory, motion.miss_memory**steps)
    before = len(old)
    stars = np.zeros(tries + before + 2, STAR)
    rows = np.empty((len(stars), most_pairs(ego, other, noise), 2), np.int64)
    star, pairs = stars[len(stars) - 1], np.empty((rows.shape[1], 2), np.int64)
    owner = np.empty(len(stars), np.int64)
    for s in range(len(stars)):
        owner[s] = -1
    jumped = np.zeros(len(stars), np.bool_)
    count = 0
    sizes = size_evidence(ego, other, noise)
    if last_differ:
        sizes[len(ego) - 1, len(other) - 1] = -_IMPOSSIBLE
    for i in range(before):
        if turn_rate_variance < np.inf:
            _correct_turn_rate(old[i], turn_rate, turn_rate_variance, is_vehicle)
        _predict(old[i], dt, motion)
        old[i].offset += offset_step
    if len(ego) > 0 and len(other) > 0:
        count = search(ego, other, sizes, noise, expected_offset, offset_std**2, tries, rounds, stars, rows)
        if claim[0, 0] < np.inf:
            _try_claim(ego, other, sizes, star, pairs, claim, expected_offset, offset_std, noise, rounds)
            if star.pairs > 0:
                count = add_star(stars, rows, count, star, pairs)
        for i in range(before):
            _follow(old[i], ego, other, sizes, star, pairs, noise, rounds)
            if star.pairs > 0:
                count = add_star(stars, rows, count, star, pairs)

    kept = np.zeros(count + before, HYPOTHESIS)
    total = count
    for i in range(before):
        h = old[i]
        gate = motion.link_distance + 2.0 * math.sqrt(max(h.cov[0, 0], h.cov[1, 1]))
        claimed, merged = -1, False
        for s in range(count):
            if same_pose(stars[s], h, gate, motion.link_angle):
                if owner[s] >= 0:
                    merged = True
                elif claimed < 0 or stars[s].evidence > stars[claimed].evidence:
                    claimed = s
        if motion.use_tracks and h.tracked_pairs >= 2 and claimed < 0 and not merged:
            # A frame that jumped (dropped frames, a sudden turn) is still tied down by what both go on tracking.
            star.pairs = _surviving_pairs(h, ego_ids, other_ids, pairs)
            if star.pairs >= 2:
                star.yaw = h.yaw
                _set_offset(h, star)
                fit_pose(ego, other, star, pairs, noise)
                for s in range(count):
                    if (
                        owner[s] < 0
                        and same_pose(stars[s], star, motion.link_distance, motion.link_angle)
                        and (claimed < 0 or stars[s].evidence > stars[claimed].evidence)
                    ):
                        claimed = s
                if claimed >= 0:
                    jumped[claimed] = True
        if claimed >= 0:
            owner[claimed] = i
        elif not merged:
            h.evidence *= miss_memory
            h.frame_evidence = 0.0
            h.pairs = 0
            if h.evidence > _FORGOTTEN:
                kept[total] = h
                total += 1
    for s in range(count):
        h = kept[s]
        fit_pose(ego, other, stars[s], rows[s], noise)
        if owner[s] >= 0:
            kept[s] = old[owner[s]]
        if owner[s] >= 0 and not jumped[s]:
            _correct(h, stars[s], motion.correlation)
        else:
            _start(h, stars[s], motion)
        evidence = stars[s].evidence - motion.absence * missing_counterparts(ego, other, stars[s], rows[s])
        if offset_std > 0.0:
            evidence -= 0.5 * ((h.offset - expected_offset) / offset_std) ** 2
        if claim[0, 0] < np.inf:
            evidence += _claim_evidence(h, claim)
        h.evidence = memory * h.evidence + (1.0 - memory) * evidence
        _remember(h, stars[s], rows[s], ego_ids, other_ids)

    ranked = np.empty(min(total, _MOST_HYPOTHESES), HYPOTHESIS)
    taken = np.zeros(total, np.bool_)
    best_star = -1
    for i in range(len(ranked)):
        best = -1
        for j in range(total):
            if not taken[j] and (best < 0 or kept[j].evidence > kept[best].evidence):
                best = j
        taken[best] = True
        ranked[i] = kept[best]
        if i == 0:
            best_star = best
    margin = ranked[0].evidence if len(ranked) else 0.0
    for i in range(1, len(ranked)):
        if not same_pose(ranked[0], ranked[i], SAME_DISTANCE, SAME_ANGLE):
            margin = ranked[0].evidence - ranked[i].evidence
            break
    frame_margin = np.inf
    for j in range(total):
        if not same_pose(ranked[0], kept[j], SAME_DISTANCE, SAME_ANGLE):
            frame_margin = min(frame_margin, ranked[0].frame_evidence - kept[j].frame_evidence)
    matched = np.empty((ranked[0].pairs if 0 <= best_star < count else 0, 2), np.int64)
    if len(matched):
        copy_pairs(matched, rows[best_star], len(matched))
    if len(ranked) == 0:
        return ranked, margin, frame_margin, np.inf, matched, 0.0, 0.0, 0.0, 0.0, np.zeros((4, 4))
    best_hypothesis = ranked[0]
    landing = _landing_std(best_hypothesis, other, is_vehicle)
    x, y, yaw, covariance = _at_origin(best_hypothesis, is_vehicle)
    return ranked, margin, frame_margin, landing, matched, x, y, yaw, best_hypothesis.offset, covariance
