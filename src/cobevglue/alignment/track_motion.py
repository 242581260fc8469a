"""Velocities of an agent's tracks, from the lists of boxes that it transmits (numba kernels).

A receiver that brings the boxes of another agent to its own instant needs their velocities, which no message contains.
They follow from the track ids of successive lists: what most tracks have in common is the motion of the agent's own
frame (a rigid transform, fitted with a robust weight), and what remains of each track is its velocity over ground, a
Kalman filter with constant velocity. Where most objects move alike, they are taken for the ground; the sum of both
motions, which is what brings a box to another instant, does not depend on that.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cobevglue._kernels import kernel
from cobevglue.alignment.evidence import X, Y

__all__ = ["TRACK", "TrackNoise", "follow_tracks"]

TRACK = np.dtype(
    [
        ("id", "i8"),
        ("x", "f8"),  # filtered position in the frame of the last list [m]
        ("y", "f8"),
        ("vx", "f8"),  # velocity over ground along the axes of that frame [m/s]
        ("vy", "f8"),
        ("position_variance", "f8"),  # of each axis, and its covariance with the velocity of that axis
        ("mixed_variance", "f8"),
        ("velocity_variance", "f8"),
        ("age", "f8"),  # time since the last detection [s]
        ("detections", "i8"),
    ],
    align=True,
)

_ROUNDS = 4
"""Refits of the frame's motion, each with weights from the residuals of the last."""
_MOST_AGE = 0.5
"""A track without detections ends after this time [s]."""
_TURN_TIME = 3.0
"""Time after which the turn rate of a vehicle is another one [s]."""
_FEWEST_DETECTIONS = 3
"""Minimum number of detections for a velocity: of two, one is often another object."""
_OTHER_OBJECT = 25.0
"""Squared innovation, in variances, above which a track id is another object now."""
_FEWEST_ANCHORS = 3
"""Minimum number of tracks for estimating the motion of the frame from theirs."""
_WIDEST_SCALE, _NARROWEST_SCALE = 64.0, 4.0
"""Squared velocity, in variances, at which a track counts a quarter in the common motion: first and last."""
_ANCHOR_PRIOR = (5.0, 5.0, 0.3)
"""Standard deviations of the common motion before the fit [m/s, m/s, rad/s]."""


class TrackNoise(NamedTuple):
    """The noise model of the tracks, standard deviations."""

    position: float = 0.3  # of a detected centre, each axis [m]
    acceleration: float = 3.0  # of an object [m/s^2]
    speed: float = 25.0  # prior of an object [m/s]
    frame_speed: float = 20.0  # prior of the frame [m/s]
    frame_turn: float = 0.3  # prior of the frame [rad/s]
    frame_acceleration: float = 4.0  # [m/s^2]
    frame_turn_acceleration: float = 0.4  # [rad/s^2]


@kernel(error_model="numpy")
def _add_point(hessian, pull, x, y, ex, ey, weight) -> None:
    """Add a point at (x, y) with residual (ex, ey) to the normal equations of a planar rigid motion.

    Only the upper triangle of the (3, 3) hessian is filled.
    """
    hessian[0, 0] += weight
    hessian[1, 1] += weight
    hessian[0, 2] -= weight * y
    hessian[1, 2] += weight * x
    hessian[2, 2] += weight * (x * x + y * y)
    pull[0] += weight * ex
    pull[1] += weight * ey
    pull[2] += weight * (x * ey - y * ex)


@kernel(error_model="numpy")
def _gauss_newton_step(motion, hessian, pull):
    """Move `motion` (3,) by the solution of the normal equations, and return its (3, 3) covariance."""
    hessian[2, 0], hessian[2, 1] = hessian[0, 2], hessian[1, 2]
    left = np.linalg.inv(hessian)
    for i in range(3):
        for j in range(3):
            motion[i] += left[i, j] * pull[j]
    return left


@kernel(error_model="numpy")
def _fit_frame_motion(before, now, variance, expected, prior, count):
    """The rigid motion (x, y, yaw) that most of `count` points share: Gauss-Newton with a Cauchy weight and a prior.

    Args:
        before: (>= count, 2) predicted points in the frame of before [m].
        now: (>= count, 2) the same points in the frame of now.
        variance: (>= count,) of each axis of their difference [m^2].
        expected: (3,) the predicted motion.
        prior: (3,) variances of the predicted motion.
        count: how many.

    Returns:
        The motion (3,) and its variances (3,).
    """
    motion, left = expected.copy(), np.diag(prior)
    for _ in range(_ROUNDS):
        cos, sin = math.cos(motion[2]), math.sin(motion[2])
        hessian, pull = np.zeros((3, 3)), np.zeros(3)
        for i in range(3):
            hessian[i, i] = 1.0 / prior[i]
            pull[i] = (expected[i] - motion[i]) / prior[i]
        for i in range(count):
            x, y = cos * before[i, 0] - sin * before[i, 1], sin * before[i, 0] + cos * before[i, 1]
            ex, ey = now[i, 0] - x - motion[0], now[i, 1] - y - motion[1]
            weight = 1.0 / (variance[i] + ex * ex + ey * ey)
            _add_point(hessian, pull, x, y, ex, ey, weight)
        left = _gauss_newton_step(motion, hessian, pull)
    return motion, np.array([left[0, 0], left[1, 1], left[2, 2]])


@kernel(error_model="numpy")
def _fit_common_motion(tracks, count):
    """The rigid motion (vx, vy, turn rate) that most of `count` tracks share over ground.

    Graduated non-convexity with a Geman-McClure weight: the scale falls from all tracks to those within the noise, so
    that the largest group with a common motion decides and not the mean of all.

    Args:
        tracks: `TRACK` records.
        count: how many.

    Returns:
        Velocity at the origin and turn rate (3,); 0 for fewer than `_FEWEST_ANCHORS` tracks.
    """
    motion = np.zeros(3)
    if count < _FEWEST_ANCHORS:
        return motion
    scale = _WIDEST_SCALE
    while True:
        hessian, pull = np.zeros((3, 3)), np.zeros(3)
        for i in range(3):
            hessian[i, i] = 1.0 / (_ANCHOR_PRIOR[i] * _ANCHOR_PRIOR[i])
            pull[i] = -motion[i] * hessian[i, i]
        for t in range(count):
            x, y = tracks[t].x, tracks[t].y
            ex = tracks[t].vx - motion[0] + motion[2] * y
            ey = tracks[t].vy - motion[1] - motion[2] * x
            variance = tracks[t].velocity_variance
            weight = 1.0 / (1.0 + (ex * ex + ey * ey) / (scale * variance))
            weight *= weight / variance
            _add_point(hessian, pull, x, y, ex, ey, weight)
        _gauss_newton_step(motion, hessian, pull)
        if scale <= _NARROWEST_SCALE:
            return motion
        scale *= 0.5


@kernel(error_model="numpy")
def _begin(track, identity, x, y, noise) -> None:
    """A track of one detection, at rest as far as is known."""
    track.id, track.x, track.y, track.vx, track.vy = identity, x, y, 0.0, 0.0
    track.position_variance, track.mixed_variance = noise.position**2, 0.0
    track.velocity_variance, track.age, track.detections = noise.speed**2, 0.0, 1


@kernel(error_model="numpy")
def follow_tracks(old, twist, twist_variance, boxes, ids, dt, noise):
    """One list of boxes: the frame's motion since the last list, and the velocity of each track.

    Args:
        old: (T,) `TRACK` records of the last list, ascending by id; overwritten.
        twist: (3,) velocity of points at rest in the agent's frame, and turn rate [m/s, m/s, rad/s].
        twist_variance: (3,) its variances.
        boxes: (N, >= 5) boxes in the agent's frame.
        ids: (N,) track ids, or (0,) where there are none.
        dt: seconds since the last list.
        noise: `TrackNoise`.

    Returns:
        The (T',) tracks, ascending by id; the (3,) twist and its (3,) variances; and (N, 3): velocity over ground of
        each box along the frame's axes [m/s], and its variance on each axis [m^2/s^2].
    """
    n_count = len(boxes)
    motion_of = np.zeros((n_count, 3))
    if len(ids) == 0:
        for n in range(n_count):
            motion_of[n, 2] = noise.speed**2
        return old[:0].copy(), twist, twist_variance, motion_of
    order = np.argsort(ids)
    row = np.full(len(old), -1, np.int64)  # of each old track, its box
    t = 0
    for k in range(n_count):
        while t < len(old) and old[t].id < ids[order[k]]:
            t += 1
        if t < len(old) and old[t].id == ids[order[k]]:
            row[t] = order[k]

    before, now, variance = np.empty((len(old), 2)), np.empty((len(old), 2)), np.empty(len(old))
    count = 0
    for t in range(len(old)):
        track = old[t]
        track.x += dt * track.vx
        track.y += dt * track.vy
        q = noise.acceleration**2
        track.position_variance += dt * (2.0 * track.mixed_variance + dt * track.velocity_variance) + 0.25 * q * dt**4
        track.mixed_variance += dt * track.velocity_variance + 0.5 * q * dt**3
        track.velocity_variance += q * dt**2
        track.age += dt
        if row[t] >= 0:
            before[count, 0], before[count, 1] = track.x, track.y
            now[count, 0], now[count, 1] = boxes[row[t], X], boxes[row[t], Y]
            variance[count] = track.position_variance + noise.position**2
            count += 1
    expected, prior = np.empty(3), np.empty(3)
    for i in range(3):
        q = (noise.frame_acceleration if i < 2 else noise.frame_turn_acceleration) ** 2
        expected[i] = dt * twist[i] * (1.0 if i < 2 else math.exp(-dt / _TURN_TIME))
        prior[i] = dt * dt * (twist_variance[i] + q * dt * dt)
    motion, motion_variance = _fit_frame_motion(before, now, variance, expected, prior, count)

    kept = np.empty(len(old) + n_count, TRACK)
    cos, sin = math.cos(motion[2]), math.sin(motion[2])
    k = total = 0
    for t in range(len(old) + 1):
        # New tracks with ids below that of old track t come first, so that ids stay ascending.
        while k < n_count and (t == len(old) or ids[order[k]] < old[t].id):
            n = order[k]
            _begin(kept[total], ids[n], boxes[n, X], boxes[n, Y], noise)
            motion_of[n, 2] = noise.speed**2
            total += 1
            k += 1
        if t == len(old):
            break
        track = old[t]
        x, y, vx, vy = track.x, track.y, track.vx, track.vy
        track.x, track.y = cos * x - sin * y + motion[0], sin * x + cos * y + motion[1]
        track.vx, track.vy = cos * vx - sin * vy, sin * vx + cos * vy
        n = row[t]
        if n >= 0:
            k += 1
            ex, ey = boxes[n, X] - track.x, boxes[n, Y] - track.y
            total_variance = track.position_variance + noise.position**2
            if ex * ex + ey * ey > _OTHER_OBJECT * total_variance:
                _begin(track, ids[n], boxes[n, X], boxes[n, Y], noise)
            else:
                gain, velocity_gain = track.position_variance / total_variance, track.mixed_variance / total_variance
                track.x += gain * ex
                track.y += gain * ey
                track.vx += velocity_gain * ex
                track.vy += velocity_gain * ey
                track.velocity_variance -= velocity_gain * track.mixed_variance
                track.mixed_variance *= 1.0 - gain
                track.position_variance *= 1.0 - gain
                track.age = 0.0
                track.detections += 1
            motion_of[n, 0], motion_of[n, 1], motion_of[n, 2] = track.vx, track.vy, track.velocity_variance
            if track.detections < _FEWEST_DETECTIONS:
                motion_of[n, 2] = noise.speed**2
        if track.age <= _MOST_AGE:
            kept[total] = track
            total += 1
    twist = motion / dt
    # What all tracks share is the motion of the frame, whichever of the two it was taken for so far.
    common = _fit_common_motion(kept, total)
    for i in range(3):
        twist[i] += common[i]
    for t in range(total):
        kept[t].vx -= common[0] - common[2] * kept[t].y
        kept[t].vy -= common[1] + common[2] * kept[t].x
    for n in range(n_count):
        motion_of[n, 0] -= common[0] - common[2] * boxes[n, Y]
        motion_of[n, 1] -= common[1] + common[2] * boxes[n, X]
    return kept[:total].copy(), twist, motion_variance / (dt * dt), motion_of
