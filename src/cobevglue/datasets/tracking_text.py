"""Text files of multi-object tracking in AB3DMOT's format: detected or labelled boxes by frame.

Every reader returns one `Boxes` per frame, for frames 0 to `frame_count - 1` including empty ones, so that sequences of
several files (two agents; detections and labels) correspond: `frame_count` is by default the last frame in the file
plus one, and `count_frames` gives that over several files.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Collection
from functools import partial
from pathlib import Path
from typing import NamedTuple

from cobevglue.boxes import Boxes
from cobevglue.datasets.v2v4real import LEFT_HANDED

__all__ = [
    "TextBox",
    "count_frames",
    "kitti_box",
    "read_kitti_detections",
    "read_kitti_labels",
    "read_v2v4real_detections",
    "read_v2v4real_labels",
]

_DETECTED_KINDS = {1: "pedestrian", 2: "car", 3: "cyclist"}


class TextBox(NamedTuple):
    """One box of a text file, in the axes of the package: centre and size [m], yaw [rad]."""

    center: tuple[float, float, float]
    size: tuple[float, float, float]
    yaw: float


class _Row(NamedTuple):
    box: TextBox
    score: float | None
    track_id: int | None
    label: str


def count_frames(*paths: str | Path) -> int:
    """The last frame number in any of these files plus one, 0 if they are empty."""
    return max((_frame(path, *line) for path in map(Path, paths) for line in _lines(path)), default=-1) + 1


def read_v2v4real_detections(
    path: str | Path, frame_count: int | None = None, left_handed: bool = LEFT_HANDED
) -> list[Boxes]:
    """Detections of one car of V2V4Real, both cars' in the LiDAR frame of the ego car.

    A line is `frame,type,0,0,0,0,score,h,w,l,x,z,y,yaw,0` with x, y, z the box centre.

    Args:
        path: the file.
        frame_count: number of frames to return.
        left_handed: the y axis points to the right; it is mirrored (see `cobevglue.datasets.v2v4real` for the default).

    Returns:
        A `Boxes` with score and label per frame.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: a malformed line, or a frame beyond `frame_count`; the message names the file and the line.
    """
    return _read_detections(path, partial(_v2v4real_box, left_handed), frame_count)


def read_v2v4real_labels(
    path: str | Path, frame_count: int | None = None, left_handed: bool = LEFT_HANDED
) -> list[Boxes]:
    """Labelled tracks of V2V4Real in the LiDAR frame of the ego car; the ego car's own box is among them.

    A line is `frame id class` seven times 0, then `h w l x z y yaw`, with x, y, z the box centre.

    Args:
        path: the file.
        frame_count: number of frames to return.
        left_handed: the y axis points to the right; it is mirrored.

    Returns:
        A `Boxes` with track_id and label per frame.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: a malformed line or an id repeated in a frame; the message names the file and the line.
    """
    return _read_labels(path, partial(_v2v4real_box, left_handed), frame_count)


def read_kitti_detections(path: str | Path, frame_count: int | None = None) -> list[Boxes]:
    """Detections of a KITTI tracking sequence, in a frame at the camera with x forward, y left, z up.

    A line is `frame,type,` four numbers of the box in the image, `score,h,w,l,x,y,z,rotation_y,alpha` in camera
    coordinates. Scores are the detector's own and not limited to [0, 1].

    Args:
        path: the file.
        frame_count: number of frames to return.

    Returns:
        A `Boxes` with score and label per frame.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: a malformed line, or a frame beyond `frame_count`; the message names the file and the line.
    """
    return _read_detections(path, kitti_box, frame_count)


def read_kitti_labels(
    path: str | Path, classes: Collection[str] = ("car",), frame_count: int | None = None
) -> list[Boxes]:
    """Labelled tracks of a KITTI tracking sequence, in a frame at the camera with x forward, y left, z up.

    A line is `frame id class truncated occluded alpha` four numbers of the box in the image `h w l x y z rotation_y`.

    Args:
        path: the file.
        classes: the classes to keep, case-insensitive; "DontCare" regions have no 3D box.
        frame_count: number of frames to return.

    Returns:
        A `Boxes` with track_id and lower-case label per frame.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: a malformed line or an id repeated in a frame; the message names the file and the line.
    """
    return _read_labels(path, kitti_box, frame_count, {name.lower() for name in classes})


def _v2v4real_box(
    left_handed: bool, height: float, width: float, length: float, x: float, z: float, y: float, yaw: float
) -> TextBox:
    side = -1.0 if left_handed else 1.0
    return TextBox((x, side * y, z), (length, width, height), side * yaw)


def kitti_box(height: float, width: float, length: float, x: float, y: float, z: float, rotation_y: float) -> TextBox:
    """Convert a box from KITTI's camera coordinates to the frame at the camera with x forward, y left, z up.

    Camera axes are x right, y down, z forward; the location is the centre of the bottom of the box.
    At rotation_y = 0 the heading is along camera x; positive angles rotate it from x to -z. The heading is thus
    (cos, -sin) in camera x and z, which is (-sin, -cos) forward and left.
    """
    return TextBox((z, -x, -y + height / 2), (length, width, height), -rotation_y - math.pi / 2)


def _read_detections(path: str | Path, box: Callable[..., TextBox], frame_count: int | None) -> list[Boxes]:
    """`box` converts the seven numbers from the height on to a box."""

    def parse(words: list[str]) -> _Row:
        kind, _, _, _, _, score, *numbers, _ = _floats(words[1:])
        return _Row(box(*numbers), score, None, _detected_kind(kind))

    return _read(path, 15, parse, frame_count)


def _read_labels(
    path: str | Path, box: Callable[..., TextBox], frame_count: int | None, classes: Collection[str] | None = None
) -> list[Boxes]:
    """`box` converts the seven numbers from the height on to a box; `classes` in lower case, None for all."""

    def parse(words: list[str]) -> _Row | None:
        label = words[2].lower()
        if classes is not None and label not in classes:
            return None
        return _Row(box(*_floats(words[10:])), None, _track_id(words[1]), label)

    return _read(path, 17, parse, frame_count)


def _detected_kind(code: float) -> str:
    if code not in _DETECTED_KINDS:
        raise ValueError(f"unknown type {code:g}, must be one of 1 (pedestrian), 2 (car), 3 (cyclist)")
    return _DETECTED_KINDS[int(code)]


def _track_id(word: str) -> int:
    try:
        return int(word)
    except ValueError:
        raise ValueError(f"the track id must be an integer, got {word!r}") from None


def _read(
    path: str | Path, columns: int, parse: Callable[[list[str]], _Row | None], frame_count: int | None
) -> list[Boxes]:
    path = Path(path)
    frames: dict[int, list[_Row]] = {}
    first_line: dict[tuple[int, int], int] = {}
    last = -1
    for number, words in _lines(path):
        frame = _frame(path, number, words)
        last = max(last, frame)
        try:
            if frame_count is not None and frame >= frame_count:
                raise ValueError(f"frame {frame}, but there are {frame_count} frames")
            if len(words) != columns:
                raise ValueError(f"expected {columns} values, got {len(words)}")
            row = parse(words)
            if row is None:
                continue
            length, width, height = row.box.size
            if min(length, width) <= 0 or height < 0:
                raise ValueError(f"length and width must be > 0 and height >= 0, got {row.box.size}")
            if row.track_id is not None:
                first = first_line.setdefault((frame, row.track_id), number)
                if first != number:
                    raise ValueError(f"track {row.track_id} is in frame {frame} already, line {first}")
        except ValueError as error:
            raise ValueError(f"{path}:{number}: {error}") from None
        frames.setdefault(frame, []).append(row)
    return [_boxes(frames.get(frame, [])) for frame in range(last + 1 if frame_count is None else frame_count)]


def _boxes(rows: list[_Row]) -> Boxes:
    if not rows:
        return Boxes.empty()
    return Boxes(
        center=[row.box.center for row in rows],
        size=[row.box.size for row in rows],
        yaw=[row.box.yaw for row in rows],
        score=None if rows[0].score is None else [row.score for row in rows],
        track_id=None if rows[0].track_id is None else [row.track_id for row in rows],
        label=[row.label for row in rows],
    )


def _lines(path: Path) -> list[tuple[int, list[str]]]:
    """Line number, from 1, and words (separated by commas or spaces) of the non-blank lines."""
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise FileNotFoundError(f"{path} does not exist") from None
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not a text file: {error}") from None
    return [(n, line.replace(",", " ").split()) for n, line in enumerate(text.splitlines(), 1) if line.strip()]


def _frame(path: Path, number: int, words: list[str]) -> int:
    if not words or not words[0].isascii() or not words[0].isdigit():
        raise ValueError(f"{path}:{number}: a line starts with a frame number, not {words[:1]}")
    return int(words[0])


def _floats(words: list[str]) -> list[float]:
    values = [float(word) for word in words]
    if not all(map(math.isfinite, values)):
        raise ValueError(f"not finite: {' '.join(words)}")
    return values
