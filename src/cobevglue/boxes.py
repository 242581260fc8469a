"""Upright 3-D boxes of one frame, the objects that every part of the system speaks of."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np

from cobevglue.se2 import SE2, wrap_angle
from cobevglue.typing import ArrayLike, BoolArray, FloatArray, IntArray, StrArray

__all__ = ["Boxes", "covers_origin", "local_coordinates"]


@dataclass(frozen=True, eq=False, slots=True)
class Boxes:
    """N boxes standing upright in one agent's frame, validated once and immutable.

    Axes are right-handed: x forward, y left, z up; yaw turns x towards y. Array-likes are accepted and copied.

    Attributes:
        center: (N, 3) box centres [m].
        size: (N, 3) length (along the heading), width, height [m]; length and width > 0, height may be 0 (unknown).
        yaw: (N,) heading [rad].
        score: (N,) detection confidence, or None.
        track_id: (N,) integers, unique, or None.
        label: (N,) class names, or None.

    Raises:
        ValueError: naming field and row: wrong shape, NaN or infinite, not a number, negative size, duplicate id.
    """

    center: FloatArray
    size: FloatArray
    yaw: FloatArray
    score: FloatArray | None = None
    track_id: IntArray | None = None
    label: StrArray | None = None

    def __init__(
        self,
        center: ArrayLike,
        size: ArrayLike,
        yaw: ArrayLike,
        score: ArrayLike | None = None,
        track_id: ArrayLike | None = None,
        label: ArrayLike | None = None,
    ) -> None:
        n = _row_count(center)
        _set(self, "center", _finite("center", center, (n, 3)))
        _set(self, "size", _finite("size", size, (n, 3)))
        _set(self, "yaw", _finite("yaw", yaw, (n,)))
        _set(self, "score", None if score is None else _finite("score", score, (n,)))
        _set(self, "track_id", None if track_id is None else _unique_integers(track_id, n))
        _set(self, "label", None if label is None else _strings(label, n))
        too_small = (self.size[:, :2] <= 0).any(axis=1) | (self.size[:, 2] < 0)
        if too_small.any():
            row = int(too_small.argmax())
            raise ValueError(f"size: row {row} is {self.size[row].tolist()}; length and width must be > 0, height >= 0")

    @classmethod
    def empty(cls) -> Boxes:
        """No boxes; scores, ids and labels are absent."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3)), np.zeros(0))

    @classmethod
    def concatenate(cls, parts: Sequence[Boxes]) -> Boxes:
        """All boxes of `parts`, in order. An optional field survives if every non-empty part has it."""
        filled = [part for part in parts if len(part)]
        if not filled:
            return parts[0] if parts else cls.empty()
        columns = {}
        for field in fields(cls):
            values = [getattr(part, field.name) for part in filled]
            columns[field.name] = None if any(v is None for v in values) else np.concatenate(values)
        return cls(**columns)

    def __reduce__(self) -> tuple[type[Boxes], tuple[FloatArray | IntArray | StrArray | None, ...]]:
        # Copies and pickles go through the constructor: numpy would restore the arrays writable.
        return type(self), tuple(getattr(self, field.name) for field in fields(self))

    def __len__(self) -> int:
        return len(self.yaw)

    def __getitem__(self, rows: ArrayLike) -> Boxes:
        """The boxes of these rows: a slice, a boolean mask or integer rows (always a `Boxes`, also for one row)."""
        index = rows if isinstance(rows, slice) else np.atleast_1d(np.asarray(rows))
        if isinstance(index, np.ndarray) and index.size == 0:
            index = index.astype(np.int64)
        return Boxes(**{f.name: None if (v := getattr(self, f.name)) is None else v[index] for f in fields(self)})

    def replace(self, **changes: ArrayLike | None) -> Boxes:
        """A copy with these fields changed (`boxes.replace(score=None)`)."""
        return Boxes(**{**{f.name: getattr(self, f.name) for f in fields(self)}, **changes})

    def transform(self, dst_SE2_src: SE2) -> Boxes:
        """These boxes (given in src) in the dst frame."""
        return self.replace(center=dst_SE2_src.apply(self.center), yaw=self.yaw + dst_SE2_src.yaw)

    @property
    def bev(self) -> FloatArray:
        """(N, 5) x, y, length, width, yaw: the boxes seen from above."""
        return np.column_stack([self.center[:, :2], self.size[:, :2], self.yaw])

    def flip_headings(self, which: ArrayLike) -> Boxes:
        """These boxes, those that `which` (N,) is True for turned by 180 degrees, with headings in [-pi, pi)."""
        return self.replace(yaw=np.where(which, wrap_angle(self.yaw + np.pi), self.yaw))

    def bev_corners(self) -> FloatArray:
        """(N, 4, 2) corners seen from above, counter-clockwise from front left [m]."""
        half = np.array([[0.5, 0.5], [-0.5, 0.5], [-0.5, -0.5], [0.5, -0.5]]) * self.size[:, None, :2]
        c, s = np.cos(self.yaw)[:, None], np.sin(self.yaw)[:, None]
        turned = np.stack([c * half[..., 0] - s * half[..., 1], s * half[..., 0] + c * half[..., 1]], axis=-1)
        corners: FloatArray = turned + self.center[:, None, :2]
        return corners


def covers_origin(boxes: Boxes) -> BoolArray:
    """(N,) whether a box covers the origin of its frame in bird's-eye view, as the sensor's own vehicle does."""
    c, s = np.cos(boxes.yaw), np.sin(boxes.yaw)
    x, y = boxes.center[:, 0], boxes.center[:, 1]
    covers: BoolArray = (2 * abs(c * x + s * y) < boxes.size[:, 0]) & (2 * abs(c * y - s * x) < boxes.size[:, 1])
    return covers


def local_coordinates(points: ArrayLike, center: ArrayLike, yaw: ArrayLike) -> FloatArray:
    """(N, 3) points as seen from a box, or each from its own: x along the heading, y to the left, from the centre [m].

    Args:
        points: (N, 3) x, y, z [m].
        center: (3,) or (N, 3), the boxes' [m].
        yaw: scalar or (N,), the boxes' [rad].
    """
    offset = np.asarray(points, dtype=np.float64) - center
    c, s = np.cos(yaw), np.sin(yaw)
    return np.column_stack([c * offset[:, 0] + s * offset[:, 1], c * offset[:, 1] - s * offset[:, 0], offset[:, 2]])


def _set(boxes: Boxes, name: str, value: FloatArray | IntArray | StrArray | None) -> None:
    """Assign a field of the frozen dataclass and make its array read-only."""
    if value is not None:
        value.setflags(write=False)
    object.__setattr__(boxes, name, value)


def _row_count(center: ArrayLike) -> int:
    try:
        return len(center)
    except TypeError:
        raise ValueError(f"center must have shape (N, 3), got {center!r}") from None


def _finite(name: str, values: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    try:
        raw = np.asarray(values)
        if raw.dtype.kind not in "biufO":  # text would be parsed silently, complex numbers lose their imaginary part
            raise ValueError(f"these are {raw.dtype}")
        array = np.array(raw, dtype=np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        _refuse_first_bad_row(name, values, shape[1:])
        raise ValueError(f"{name} must be numbers of shape {shape}: {error}") from None
    if array.size == 0 and shape[0] == 0:
        array = array.reshape(shape)
    if array.shape != shape:
        raise ValueError(f"{name} must have shape {shape}, got {array.shape}")
    finite = np.isfinite(array)
    if not finite.all():
        row = int((~finite).reshape(len(array), -1).any(axis=1).argmax())
        raise ValueError(f"{name}: row {row} is not finite: {array[row].tolist()}")
    return array


def _refuse_first_bad_row(name: str, values: ArrayLike, shape: tuple[int, ...]) -> None:
    """Raise a ValueError that names the first row that is not numbers of this shape, if there is one."""
    rows = values if isinstance(values, (list, tuple, np.ndarray)) else []
    for number, row in enumerate(rows):
        try:
            array = np.asarray(row)
            good = array.shape == shape and array.dtype.kind in "biufO" and array.astype(np.float64) is not None
        except (TypeError, ValueError, OverflowError):
            good = False
        if not good:
            raise ValueError(
                f"{name}: row {number} must be {'a number' if not shape else f'{shape[0]} numbers'}: {row!r}"
            )


def _unique_integers(values: ArrayLike, n: int) -> IntArray:
    ids = _integers(values, n)
    order = np.argsort(ids, kind="stable")
    repeated = ids[order][1:] == ids[order][:-1]
    if repeated.any():
        first, second = order[repeated.argmax()], order[repeated.argmax() + 1]
        raise ValueError(f"track_id: rows {first} and {second} have the same id {ids[first]}")
    return ids


def _integers(values: ArrayLike, n: int) -> IntArray:
    """(n,) whole numbers; integers are taken as they are, since above 2^53 a detour over floats would change them."""
    numbers = _finite("track_id", values, (n,))
    in_range = np.abs(numbers) < 2.0**63
    if not in_range.all():
        row = int((~in_range).argmax())
        raise ValueError(f"track_id: row {row} is {numbers[row]:.0f}, ids must be below 2^63")
    raw = np.asarray(values)
    ids: IntArray = (raw if raw.dtype.kind in "iu" else numbers).astype(np.int64).reshape(n)
    if raw.dtype.kind not in "iu" and (ids != numbers).any():
        row = int((ids != numbers).argmax())
        raise ValueError(f"track_id: row {row} is not an integer: {numbers[row]}")
    return ids


def _strings(values: ArrayLike, n: int) -> StrArray:
    array = np.array(values, dtype=np.str_)
    if array.size == 0 and n == 0:
        array = array.reshape(0)
    if array.shape != (n,):
        raise ValueError(f"label must have shape ({n},), got {array.shape}")
    return array
