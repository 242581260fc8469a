"""A SORT-style multi-object tracker in bird's-eye view, for boxes seen from a vehicle whose own motion is unknown.

After Bewley et al., "Simple Online and Realtime Tracking" (ICIP 2016): a constant-velocity Kalman filter for each track
and the Hungarian method for association. Three things differ, since no localisation is available and identities are the
output:

- Ego-motion is estimated from the tracks. From a vehicle at 20 m/s, a parked car moves by 2 m a frame. The motion that
  most tracks share is taken for that of the frame: it is fitted to the associations of each frame and predicts all
  tracks in the next one, also new ones. The velocity of a track is the remainder.
- Every detection gets an identity at once. The object matching uses identities as hints, and needs them early and pure
  (one identity, one object) rather than long.
- Headings may be flipped: a heading that is off by 180 degrees neither ends nor rotates a track.

Importing this module imports neither torch nor numba; the first `update` imports numba for the overlap of boxes.
"""

from __future__ import annotations

import cmath
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from numpy.lib.stride_tricks import sliding_window_view
from pydantic import Field

from cobevglue.boxes import Boxes
from cobevglue.clock import Clock
from cobevglue.se2 import SE2, wrap_angle
from cobevglue.settings import Settings
from cobevglue.typing import BoolArray, FloatArray, IntArray

__all__ = ["Sort", "SortConfig", "Tracks"]

_ComplexArray = npt.NDArray[np.complex128]
"""Vectors of the plane, x + iy: turning one is a multiplication."""

_NONE = np.zeros(0, dtype=np.int64)
_SAME_TIME = 1e-6
"""Slack of `max_age` [s]: a clock that counts tenths of seconds counts in no binary fractions."""
_UNKNOWN = 1.0
"""Uncertainty of the frame's translation above which it is searched for and not only refined [m]."""
_CELL, _CELLS = 0.5, 10
"""Size of a cell [m] and half the number of them along each side, in that search: motions up to 5 m a frame."""
_SAME_PLACE = 0.2
"""If the correction of the frame's motion moves all predictions by less, they are not associated again [m]."""
_ROUNDS = 4
"""Maximum rounds of association and correction of the frame's motion in an update."""
_NEW = 0.9
"""A track whose velocity has this share of its prior standard deviation or more has one detection."""
_ASIDE, _SAME_ROAD, _SAME_LENGTH = 1.2, math.sin(math.radians(15.0)), 1.5
"""Maximum offset from the course [m], heading difference (sine) and length difference [m] of a fast new object."""
_HEADING_GAIN, _SHAPE_GAIN, _FRONT_GAIN = 0.5, 0.3, 0.2
"""Weights of a new detection in a track's heading, in its size and height, and in the vote on its direction."""


class SortConfig(Settings):
    """Settings of `Sort`. CoBEVGlue's paper gives none; these were chosen on V2V4Real's training sequences.

    `benchmarks/tracking.py` measures them: without `frame_motion` an object changes its identity twice as often, more
    in a bend; a shorter `max_age` makes identities shorter and no purer; `giou` is a little better than `distance` on
    KITTI and V2V4Real.

    Attributes:
        affinity: of a detection and a predicted track: `giou`, the generalised IoU of their boxes, or `distance`, of
            their centres.
        max_distance: maximum distance of a detection from the predicted centre [m].
        min_giou: minimum generalised IoU of a detection and the predicted box (with `giou`).
        max_age: maximum time without a detection, and maximum gap in the input, before a track ends [s].
        period: time between updates without a time [s].
        position_noise: standard deviation of a detected centre on each axis [m].
        acceleration_noise: standard deviation of an object's acceleration on each axis [m/s^2].
        velocity_prior: standard deviation of a new object's own velocity on each axis [m/s].
        max_speed: the fastest objects relative to the frame [m/s].
        frame_motion: estimate the frame's motion; False for a frame that is known not to move.
        frame_speed_prior: standard deviation of the frame's velocity on each axis at the start [m/s].
        frame_turn_prior: standard deviation of the frame's turn rate at the start [rad/s].
        frame_acceleration_noise: standard deviation of the frame's acceleration on each axis [m/s^2].
        frame_turn_noise: standard deviation of the frame's angular acceleration [rad/s^2].

    Raises:
        ValueError: a value out of range or an unknown field; names the field.
    """

    affinity: Literal["distance", "giou"] = "giou"
    max_distance: float = Field(default=4.5, gt=0, allow_inf_nan=False)
    min_giou: float = Field(default=-0.4, ge=-1, le=1)
    max_age: float = Field(default=1.0, gt=0, allow_inf_nan=False)
    period: float = Field(default=0.1, gt=0, allow_inf_nan=False)
    position_noise: float = Field(default=0.3, gt=0, allow_inf_nan=False)
    acceleration_noise: float = Field(default=4.0, gt=0, allow_inf_nan=False)
    velocity_prior: float = Field(default=10.0, gt=0, allow_inf_nan=False)
    max_speed: float = Field(default=70.0, gt=0, allow_inf_nan=False)
    frame_motion: bool = True
    frame_speed_prior: float = Field(default=20.0, gt=0, allow_inf_nan=False)
    frame_turn_prior: float = Field(default=0.5, gt=0, allow_inf_nan=False)
    frame_acceleration_noise: float = Field(default=8.0, gt=0, allow_inf_nan=False)
    frame_turn_noise: float = Field(default=1.2, gt=0, allow_inf_nan=False)


@dataclass(frozen=True, slots=True, eq=False)
class Tracks:
    """The state of N active tracks, including those without a detection in the last update.

    Attributes:
        boxes: N boxes in the agent's frame: filtered centre and heading, smoothed size, `track_id`.
        velocity: (N, 2) velocity over ground along the frame's axes [m/s]. Where all objects move alike, their motion
            is taken for the frame's.
        unseen: (N,) time since the last detection [s].
    """

    boxes: Boxes
    velocity: FloatArray
    unseen: FloatArray


class Sort:
    """Assigns track ids to the boxes of successive frames. One tracker per agent.

        tracker = Sort()
        for boxes in frames:
            tracked = tracker.update(boxes)  # the same boxes, with track_id

    The same input gives the same ids. An id is never assigned to a second track, not even after `reset`.

    Args:
        config: settings; the defaults are for vehicles at 10 Hz.
    """

    def __init__(self, config: SortConfig | None = None) -> None:
        self.config = config or SortConfig()
        self._next_id = 0
        self.reset()

    def reset(self) -> None:
        """Delete all tracks, the frame's motion and the time. Ids continue to increase."""
        self._clock = Clock(self.config.period)
        self._tracks = _State()
        self._frame = _FrameMotion(self.config)

    def update(self, boxes: Boxes, time: float | None = None, heading_confidence: FloatArray | None = None) -> Boxes:
        """Assign track ids to the boxes of the next frame.

        All boxes are returned unchanged and in the same order: detections, not filtered states, which `tracks` has.

        Args:
            boxes: N detections in the agent's frame; scores, labels and any `track_id` are not used.
            time: of the detections [s], on any clock; by default `config.period` after the last update. After a gap
                longer than `config.max_age` all tracks are new.
            heading_confidence: (N,) in [0, 1] of the direction of each heading (front or back); 1 for all if None.

        Returns:
            The N boxes with `track_id`.

        Raises:
            ValueError: `time` is not finite, not in seconds or not later than the last one, or `heading_confidence` is
                not one number in [0, 1] for each box; the tracker is then unchanged.
        """
        votes = np.ones(len(boxes)) if heading_confidence is None else np.asarray(heading_confidence, dtype=np.float64)
        if votes.shape != (len(boxes),) or not ((votes >= 0.0) & (votes <= 1.0)).all():
            raise ValueError(
                f"heading_confidence must be {len(boxes)} numbers in [0, 1], got shape {votes.shape}: {votes}"
            )
        dt = self._clock.advance(time)
        time = self._now
        self._end_lost_tracks(time)
        self._predict(dt)
        rows, columns = self._associate(boxes, dt)
        self._correct(rows, boxes, columns, time, votes)
        ids = self._begin_new_tracks(rows, boxes, columns, time, votes)
        return boxes.replace(track_id=ids)

    def vote_headings(self, boxes: Boxes) -> Boxes:
        """Boxes of the last update, each rotated by 180 degrees where its heading is opposite to its track's.

        The heading of a track is decided by votes of its detections, weighted by recency and heading confidence.

        Args:
            boxes: some or all of what `update` returned last, in any order.

        Raises:
            ValueError: a box without a living track.
        """
        s = self._tracks
        ids = _NONE if boxes.track_id is None else boxes.track_id
        rows = np.searchsorted(s.id, ids)
        if len(ids) != len(boxes) or not (rows < len(s)).all() or not (s.id[rows] == ids).all():
            raise ValueError("boxes must have the track_id of living tracks, as update returns them")
        return boxes.flip_headings(np.cos(boxes.yaw - s.yaw[rows]) < 0.0)

    @property
    def tracks(self) -> Tracks:
        """The active tracks, filtered up to the last update."""
        s = self._tracks
        center = np.column_stack([s.position.real, s.position.imag, s.shape[:, 3]])
        boxes = Boxes(center, s.shape[:, :3], wrap_angle(s.yaw), track_id=s.id)
        return Tracks(boxes, np.column_stack([s.velocity.real, s.velocity.imag]), self._now - s.seen)

    @property
    def now_SE2_before(self) -> SE2:
        """Motion of the frame over the last step: maps points at rest from the previous frame to the current one."""
        return SE2(self._frame.shift.real, self._frame.shift.imag, self._frame.yaw)

    @property
    def _now(self) -> float:
        """Time of the last update [s]."""
        return self._clock.time or 0.0

    def _end_lost_tracks(self, time: float) -> None:
        """Delete tracks without a detection for longer than `max_age`."""
        alive = time - self._tracks.seen <= self.config.max_age + _SAME_TIME
        if not alive.all():
            self._tracks.keep(alive)

    def _predict(self, dt: float) -> None:
        """Prediction step of the Kalman filters: constant velocity with random accelerations."""
        s, q = self._tracks, self.config.acceleration_noise**2
        s.position = s.position + dt * s.velocity
        position, mixed, velocity = s.variance
        s.variance = np.array(
            [
                position + dt * (2.0 * mixed + dt * velocity) + 0.25 * q * dt**4,
                mixed + dt * velocity + 0.5 * q * dt**3,
                velocity + q * dt**2,
            ]
        )

    def _associate(self, boxes: Boxes, dt: float) -> tuple[IntArray, IntArray]:
        """Associated rows of tracks and of boxes; transforms the tracks to the current frame.

        The motion of the frame is predicted first, then corrected by the associations. If that changes the predictions,
        boxes are associated again.
        """
        s, frame, detected = self._tracks, self._frame, _plane(boxes)
        frame.predict(dt)
        if self.config.frame_motion and frame.shift_std > _UNKNOWN:
            frame.acquire(s.position, detected)
        rows, columns, at = _NONE, _NONE, frame.apply(s.position)
        for _ in range(_ROUNDS if len(s) and len(boxes) else 0):
            rows, columns = self._assign(at, boxes)
            if not self.config.frame_motion or not len(rows):
                break
            variance = s.variance[0, rows] + self.config.position_noise**2
            frame.correct(s.position[rows], detected[columns], variance)
            before, at = at, frame.apply(s.position)
            if np.abs(at - before).max() < _SAME_PLACE:
                break
        s.position, s.velocity, s.yaw = at, frame.turn(s.velocity), s.yaw + frame.yaw
        fast_rows, fast_columns = self._assign_fast(rows, boxes, columns, dt)
        return np.concatenate([rows, fast_rows]), np.concatenate([columns, fast_columns])

    def _assign_fast(self, rows: IntArray, boxes: Boxes, columns: IntArray, dt: float) -> tuple[IntArray, IntArray]:
        """Further rows of tracks and of boxes: new objects that went far along their heading since the first detection.

        The velocity of a new object is unknown, and oncoming traffic moves by more than `max_distance` between frames.
        What else is left over is taken for it where it lies straight ahead or behind.
        """
        s = self._tracks
        new = np.flatnonzero(s.variance[2] > (_NEW * self.config.velocity_prior) ** 2)
        new = new[~np.isin(new, rows)]
        left = np.flatnonzero(~np.isin(np.arange(len(boxes)), columns))
        if not len(new) or not len(left):
            return _NONE, _NONE
        offset = (_plane(boxes)[left][None, :] - s.position[new][:, None]) * np.exp(-1j * s.yaw[new])[:, None]
        turn = np.abs(np.sin(boxes.yaw[left][None, :] - s.yaw[new][:, None]))
        longer = np.abs(boxes.size[left, 0][None, :] - s.shape[new, 0][:, None])
        same = (np.abs(offset.imag) < _ASIDE) & (turn < _SAME_ROAD) & (longer < _SAME_LENGTH)
        found, taken = _assign_within(np.where(same, np.abs(offset.real), np.inf), self.config.max_speed * dt)
        return new[found], left[taken]

    def _assign(self, at: _ComplexArray, boxes: Boxes) -> tuple[IntArray, IntArray]:
        """The one-to-one assignment of tracks, predicted `at` (N,), to boxes with the least cost, within the gate.

        Costs are capped at the gate, so that a good pair is never given up for a further pair outside the gate.
        """
        if self.config.affinity == "giou":
            from cobevglue._iou_kernels import giou_matrix

            s = self._tracks
            predicted = np.column_stack([at.real, at.imag, s.shape[:, :2], s.yaw + self._frame.yaw])
            cost = 1.0 - giou_matrix(predicted, boxes.bev, self.config.max_distance)
            gate = 1.0 - self.config.min_giou
        else:
            offset = at[:, None] - _plane(boxes)
            cost = offset.real**2 + offset.imag**2
            gate = self.config.max_distance**2
        return _assign_within(cost, gate)

    def _correct(self, rows: IntArray, boxes: Boxes, columns: IntArray, time: float, votes: FloatArray) -> None:
        """Update the associated tracks: a Kalman filter for the motion, moving averages for heading and shape."""
        s = self._tracks
        position, mixed, velocity = s.variance[:, rows]
        gain = position / (position + self.config.position_noise**2)
        velocity_gain = mixed / (position + self.config.position_noise**2)
        innovation = _plane(boxes)[columns] - s.position[rows]
        s.position[rows] += gain * innovation
        s.velocity[rows] += velocity_gain * innovation
        s.variance[:, rows] = (1.0 - gain) * position, (1.0 - gain) * mixed, velocity - velocity_gain * mixed
        s.shape[rows] += _SHAPE_GAIN * (_shape(boxes)[columns] - s.shape[rows])
        s.seen[rows] = time

        yaw = s.yaw[rows]
        turn = boxes.yaw[columns] - yaw
        half_turns = np.round(turn / np.pi)
        front = s.front[rows]
        front += _FRONT_GAIN * (votes[columns] * (1.0 - 2.0 * (half_turns % 2.0)) - front)
        # Brought within 90 degrees, a flipped detection turns nothing; if most are flipped, the track itself was.
        s.yaw[rows] = yaw + _HEADING_GAIN * (turn - np.pi * half_turns) + np.pi * (front < 0.0)
        s.front[rows] = np.abs(front)

    def _begin_new_tracks(
        self, rows: IntArray, boxes: Boxes, columns: IntArray, time: float, votes: FloatArray
    ) -> IntArray:
        """Begin a track for each box that was not associated, and return the ids of all boxes (N,)."""
        ids = np.full(len(boxes), -1, dtype=np.int64)
        ids[columns] = self._tracks.id[rows]
        new = np.flatnonzero(ids < 0)
        if len(new):
            ids[new] = np.arange(self._next_id, self._next_id + len(new))
            self._next_id += len(new)
            self._tracks.append(ids[new], boxes, new, time, votes, self.config)
        return ids


def _assign_within(cost: FloatArray, gate: float) -> tuple[IntArray, IntArray]:
    """Rows and columns of the cheapest one-to-one assignment, of pairs that cost less than the gate only."""
    from scipy.optimize import linear_sum_assignment

    rows, columns = linear_sum_assignment(np.minimum(cost, gate))
    inside = cost[rows, columns] < gate
    return rows[inside], columns[inside]


class _FrameMotion:
    """Motion of the frame, estimated from the motion that most tracks share: a Kalman filter on its twist.

    Attributes:
        shift: translation of now_SE2_before, where a point at rest seen before is seen now, as x + iy [m].
        yaw: its rotation [rad].
    """

    def __init__(self, config: SortConfig) -> None:
        self._set(np.zeros(3))
        self._moves = config.frame_motion
        self._noise = np.diag([config.frame_acceleration_noise] * 2 + [config.frame_turn_noise]) ** 2
        self._twist = np.zeros(3)  # [m/s, m/s, rad/s]
        self._covariance = np.diag([config.frame_speed_prior] * 2 + [config.frame_turn_prior]) ** 2
        self._expected, self._prior, self._dt = np.zeros(3), np.eye(3), config.period

    def predict(self, dt: float) -> None:
        """Prediction step: constant twist with random accelerations."""
        if self._moves:
            self._covariance = 0.5 * (self._covariance + self._covariance.T) + dt**2 * self._noise
            self._expected, self._prior, self._dt = dt * self._twist, dt**2 * self._covariance, dt
            self._set(self._expected)

    @property
    def shift_std(self) -> float:
        """Standard deviation of the predicted translation along x [m]."""
        return float(self._dt * math.sqrt(self._covariance[0, 0]))

    def acquire(self, before: _ComplexArray, now: _ComplexArray) -> None:
        """Search for the translation that most pairs of a point `before` and one `now` share.

        In a row of cars the nearest point is often that of the neighbour. All pairs vote in a grid; the 3 x 3 cells
        with the most votes are chosen, the nearest to the expected motion among equals.
        """
        offset = (now[None, :] - self.apply(before)[:, None]).ravel()
        cell = np.rint(np.column_stack([offset.real, offset.imag]) / _CELL).astype(np.int64)
        inside = (np.abs(cell) <= _CELLS).all(axis=1)
        if not inside.any():
            return
        offset, cell = offset[inside], cell[inside] + _CELLS + 1
        side = 2 * _CELLS + 1
        votes = np.zeros((side + 2, side + 2))
        np.add.at(votes, (cell[:, 0], cell[:, 1]), 1.0)
        dense = sliding_window_view(votes, (3, 3)).sum(axis=(2, 3))
        far = np.hypot(*np.mgrid[-_CELLS : _CELLS + 1, -_CELLS : _CELLS + 1])
        peak = np.array(divmod(int(np.argmax(dense - 1e-3 * far)), side)) + 1
        shift = offset[(np.abs(cell - peak) <= 1).all(axis=1)].mean()
        self._set(self._motion + [shift.real, shift.imag, 0.0])

    def correct(self, before: _ComplexArray, now: _ComplexArray, variance: FloatArray) -> None:
        """Fit the motion to points predicted `before`, in the previous frame, and detected `now`; all (N,).

        One Gauss-Newton step from the current estimate with Cauchy weights, so that moving objects and wrong
        associations have little influence.
        """
        turned = self.turn(before)
        error = now - turned - self.shift
        weight = 1.0 / (variance + error.real**2 + error.imag**2)
        # A turn by d moves a point by i * d * turned.
        total, lever, pull = weight.sum(), 1j * (weight @ turned), weight @ error
        inertia, torque = (weight @ (turned * turned.conj())).real, (weight @ (turned.conj() * error)).imag
        hessian = [[total, 0.0, lever.real], [0.0, total, lever.imag], [lever.real, lever.imag, inertia]]
        # (inv(prior) + hessian)^-1 = remaining @ prior: the share of the prior's uncertainty that the points leave.
        remaining = np.linalg.inv(np.eye(3) + self._prior @ hessian)
        step = self._expected - self._motion + self._prior @ [pull.real, pull.imag, torque]
        self._set(self._motion + remaining @ step)
        self._twist, self._covariance = self._motion / self._dt, remaining @ self._prior / self._dt**2

    def apply(self, points: _ComplexArray) -> _ComplexArray:
        """Transform points at rest (N,) from the previous frame to the current one."""
        return self.turn(points) + self.shift

    def turn(self, vectors: _ComplexArray) -> _ComplexArray:
        """Rotate vectors (N,) from the axes of the previous frame to those of the current one."""
        turned: _ComplexArray = vectors * cmath.rect(1.0, self.yaw)
        return turned

    def _set(self, motion: FloatArray) -> None:
        self._motion = motion
        self.shift, self.yaw = complex(motion[0], motion[1]), float(motion[2])


class _State:
    """The state of N tracks in the agent's frame.

    Noise is the same in every direction, so one 2 x 2 covariance of position and velocity serves both axes, and turning
    the frame leaves it as it is.
    """

    def __init__(self) -> None:
        self.id = _NONE  # ascending
        self.position: _ComplexArray = np.zeros(0, dtype=np.complex128)  # (N,) [m]
        self.velocity: _ComplexArray = np.zeros(0, dtype=np.complex128)  # (N,) the object's own [m/s]
        self.variance = np.zeros((3, 0))  # of position, of position with velocity, of velocity
        self.shape = np.zeros((0, 4))  # length, width, height, z [m]
        self.yaw = np.zeros(0)  # [rad]
        self.front = np.zeros(0)  # in [0, 1]: how clearly the detections agree on which end is the front
        self.seen = np.zeros(0)  # time of the last detection [s]

    def __len__(self) -> int:
        return len(self.id)

    def keep(self, alive: BoolArray) -> None:
        """Drop the other tracks."""
        for name, values in vars(self).items():
            setattr(self, name, values[:, alive] if name == "variance" else values[alive])

    def append(
        self, ids: IntArray, boxes: Boxes, rows: IntArray, time: float, votes: FloatArray, config: SortConfig
    ) -> None:
        """Add tracks of these rows of `boxes`, with velocity 0."""
        n = len(rows)
        prior = np.array([config.position_noise**2, 0.0, config.velocity_prior**2])
        self.id = np.concatenate([self.id, ids])
        self.position = np.concatenate([self.position, _plane(boxes)[rows]])
        self.velocity = np.concatenate([self.velocity, np.zeros(n)])
        self.variance = np.concatenate([self.variance, np.repeat(prior[:, None], n, axis=1)], axis=1)
        self.shape = np.concatenate([self.shape, _shape(boxes)[rows]])
        self.yaw = np.concatenate([self.yaw, boxes.yaw[rows]])
        # One flipped detection next shall not turn the track, a second shall.
        self.front = np.concatenate([self.front, 1.5 * _FRONT_GAIN * votes[rows]])
        self.seen = np.concatenate([self.seen, np.full(n, time)])


def _plane(boxes: Boxes) -> _ComplexArray:
    """(N,) centres seen from above, x + iy [m]."""
    centers: _ComplexArray = boxes.center[:, 0] + 1j * boxes.center[:, 1]
    return centers


def _shape(boxes: Boxes) -> FloatArray:
    """(N, 4) length, width, height, z [m]."""
    return np.column_stack([boxes.size, boxes.center[:, 2]])
