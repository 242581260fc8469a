"""KITTI: label files of the object benchmark to `Boxes`, and back.

A line is `type truncated occluded alpha left top right bottom h w l x y z rotation_y [score]`: the bottom centre of the
box in the coordinates of the rectified camera (x right, y down, z forward), and the angle about its y axis. `Boxes` are
in the frame at the camera with x forward, y left, z up (as in `cobevglue.datasets.tracking_text`, which reads the files
of the tracking benchmark), or in that of the LiDAR if its calibration is given.
"""

from __future__ import annotations

import math
from collections.abc import Collection
from pathlib import Path

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.datasets.atomic_files import atomic_write
from cobevglue.datasets.poses import inverse_SE3, rigid_SE3, transform_boxes
from cobevglue.datasets.tracking_text import kitti_box
from cobevglue.se2 import wrap_angle
from cobevglue.typing import ArrayLike, FloatArray

__all__ = [
    "boxes_from_kitti",
    "kitti_from_boxes",
    "read_kitti_calibration",
    "read_kitti_objects",
    "write_kitti_objects",
]

_CAMERA_SE3_FORWARD = np.array([[0.0, -1.0, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0], [1.0, 0.0, 0.0, 0.0], [0, 0, 0, 1.0]])
"""From the frame at the camera with x forward, y left, z up to the camera's own axes."""
_VELO_TO_CAM = ("Tr_velo_to_cam", "Tr_velo_cam")
_RECTIFICATION = ("R0_rect", "R_rect")
"""Names in the object and in the tracking benchmark."""


def boxes_from_kitti(
    rows: ArrayLike, camera_SE3_lidar: ArrayLike | None = None, score: ArrayLike | None = None, label: ArrayLike = None
) -> Boxes:
    """Convert rows of KITTI's box parameters to boxes.

    Args:
        rows: (N, 7) h, w, l [m], x, y, z [m], rotation_y [rad] in rectified camera coordinates.
        camera_SE3_lidar: (4, 4) R0_rect @ Tr_velo_to_cam, as `read_kitti_calibration` returns it, for boxes in the
            LiDAR frame, upright there; None for boxes in the frame at the camera with x forward, y left, z up.
        score: (N,) confidences, or None.
        label: (N,) types, or None.

    Raises:
        ValueError: another shape, invalid boxes, or a matrix that is not rigid; the message names field and row.
    """
    table = np.asarray(rows, dtype=np.float64).reshape(-1, 7) if np.size(rows) == 0 else np.asarray(rows, np.float64)
    if table.ndim != 2 or table.shape[1] != 7:
        raise ValueError(f"rows must have shape (N, 7), got {table.shape}")
    parts = [kitti_box(*row) for row in table.tolist()]
    boxes = Boxes(
        center=[box.center for box in parts],
        size=[box.size for box in parts],
        yaw=[box.yaw for box in parts],
        score=score,
        label=label,
    )
    return boxes if camera_SE3_lidar is None else transform_boxes(boxes, inverse_SE3(_forward(camera_SE3_lidar)))


def kitti_from_boxes(boxes: Boxes, camera_SE3_lidar: ArrayLike | None = None) -> FloatArray:
    """Convert boxes to (N, 7) rows, the inverse of `boxes_from_kitti`.

    With a calibration the round trip is exact for a camera that is level in the LiDAR frame, and otherwise loses what
    `transform_boxes` drops: the tilt between the two frames, below 1 degree in KITTI.

    Args:
        boxes: N boxes in the LiDAR frame, or without calibration in the frame at the camera.
        camera_SE3_lidar: (4, 4), or None.

    Returns:
        h, w, l [m], x, y, z [m] of the bottom centre, rotation_y in [-pi, pi) [rad].

    Raises:
        ValueError: the matrix is not rigid.
    """
    if camera_SE3_lidar is not None:
        boxes = transform_boxes(boxes, _forward(camera_SE3_lidar))
    x, y, z = boxes.center.T
    length, width, height = boxes.size.T
    rotation_y = wrap_angle(-boxes.yaw - math.pi / 2)
    return np.column_stack([height, width, length, -y, height / 2 - z, x, rotation_y])


def read_kitti_calibration(path: str | Path) -> FloatArray:
    """Read camera_SE3_lidar (4, 4) from a calibration file of the object or the tracking benchmark.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: the rectification or the LiDAR's pose is missing or malformed; the message names file and field.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except FileNotFoundError:
        raise FileNotFoundError(f"{path} does not exist") from None
    entries = {words[0].rstrip(":"): words[1:] for line in text.splitlines() if (words := line.split())}
    rectification, velo_to_cam = np.eye(4), np.eye(4)
    rectification[:3, :3] = _matrix(path, entries, _RECTIFICATION, (3, 3))
    velo_to_cam[:3] = _matrix(path, entries, _VELO_TO_CAM, (3, 4))
    return rigid_SE3(rectification @ velo_to_cam, f"{path}: {_RECTIFICATION[0]} @ {_VELO_TO_CAM[0]}")


def read_kitti_objects(
    path: str | Path, camera_SE3_lidar: ArrayLike | None = None, classes: Collection[str] | None = None
) -> Boxes:
    """Read a label or result file of the object benchmark.

    Args:
        path: the file.
        camera_SE3_lidar: (4, 4), or None; see `boxes_from_kitti`.
        classes: the types to keep, case-insensitive; None for all. "DontCare" regions, which are not boxes, are omitted
            in any case.

    Returns:
        Boxes with lower-case labels, and with scores if every line has one.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: a malformed line; the message names the file and the line.
    """
    path = Path(path)
    kept = None if classes is None else {name.lower() for name in classes}
    rows, labels, scores = [], [], []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except FileNotFoundError:
        raise FileNotFoundError(f"{path} does not exist") from None
    for number, line in enumerate(lines, 1):
        words = line.split()
        if not words or words[0].lower() == "dontcare" or (kept is not None and words[0].lower() not in kept):
            continue
        try:
            if len(words) not in (15, 16):
                raise ValueError(f"expected 15 or 16 values, got {len(words)}")
            numbers = [float(word) for word in words[8:]]
            boxes_from_kitti([numbers[:7]])
        except ValueError as error:
            raise ValueError(f"{path}:{number}: {error}") from None
        rows.append(numbers[:7])
        labels.append(words[0].lower())
        scores += numbers[7:]
    return boxes_from_kitti(rows, camera_SE3_lidar, scores if len(scores) == len(rows) and rows else None, labels)


def write_kitti_objects(path: str | Path, boxes: Boxes, camera_SE3_lidar: ArrayLike | None = None) -> None:
    """Write boxes as a result file of the object benchmark, the inverse of `read_kitti_objects`.

    What `Boxes` do not hold is written as unknown: truncation and occlusion -1, alpha -10, an image box of -1. Boxes
    without labels are written as `Car`.

    Raises:
        ValueError: a label contains white space, or the matrix is not rigid.
        OSError: the file cannot be written.
    """
    lines = []
    for row, numbers in enumerate(kitti_from_boxes(boxes, camera_SE3_lidar).tolist()):
        label = "Car" if boxes.label is None else str(boxes.label[row]).capitalize()
        if len(label.split()) != 1:
            raise ValueError(f"label: row {row} must be one word, got {label!r}")
        if boxes.score is not None:
            numbers.append(float(boxes.score[row]))
        lines.append(f"{label} -1 -1 -10 -1 -1 -1 -1 {' '.join(map(repr, numbers))}\n")
    with atomic_write(Path(path)) as file:
        file.write_text("".join(lines), encoding="utf-8")


def _forward(camera_SE3_lidar: ArrayLike) -> FloatArray:
    """From the LiDAR frame to the frame at the camera with x forward, y left, z up."""
    return inverse_SE3(_CAMERA_SE3_FORWARD) @ rigid_SE3(camera_SE3_lidar, "camera_SE3_lidar")


def _matrix(path: Path, entries: dict[str, list[str]], names: tuple[str, ...], shape: tuple[int, int]) -> FloatArray:
    words = next((entries[name] for name in names if name in entries), None)
    if words is None:
        raise ValueError(f"{path}: {names[0]} is missing")
    try:
        return np.array([float(word) for word in words]).reshape(shape)
    except ValueError:
        raise ValueError(f"{path}: {names[0]} must be {shape[0] * shape[1]} numbers") from None
