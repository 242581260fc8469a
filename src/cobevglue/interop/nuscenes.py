"""nuScenes: annotations, detection results and tracking results to `Boxes`, and back.

A record holds `translation` [x, y, z] of the box centre, `size` [width, length, height] and `rotation`, the quaternion
[w, x, y, z], all in the global frame (or another one: the devkit moves boxes to the sensor's). The x axis of a box is
along its length, as here.

The frames of nuScenes are right-handed. That of the vehicle (`ego_pose`) has x forward and y left, as here; that of
LIDAR_TOP has x to the right and y forward, so use the vehicle's.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from cobevglue.boxes import Boxes
from cobevglue.datasets.poses import inverse_SE3, rigid_SE3, upright_yaw
from cobevglue.typing import ArrayLike, FloatArray

__all__ = ["SE3_from_nuscenes", "boxes_from_nuscenes", "nuscenes_from_boxes"]

_LABELS = ("detection_name", "tracking_name", "category_name")
_SCORES = ("detection_score", "tracking_score")
_IDS = ("tracking_id", "instance_token")

Record = Mapping[str, Any]


def SE3_from_nuscenes(record: Record) -> FloatArray:
    """(4, 4) pose in a record with `translation` and `rotation`.

    Of an `ego_pose`, it is global_SE3_ego; of a `calibrated_sensor`, ego_SE3_sensor; of a box, the pose of the box.

    Raises:
        ValueError: a field is missing or malformed; the message names it.
    """
    matrix = np.eye(4)
    matrix[:3, 3] = _numbers(record, "translation", 3)
    w, x, y, z = _numbers(record, "rotation", 4)
    if not np.isclose(np.hypot(np.hypot(w, x), np.hypot(y, z)), 1.0, atol=1e-3):
        raise ValueError(f"rotation must be a unit quaternion [w, x, y, z], got {record['rotation']}")
    matrix[:3, :3] = Rotation.from_quat([x, y, z, w]).as_matrix()
    return matrix


def boxes_from_nuscenes(
    records: Sequence[Record],
    global_SE3_frame: ArrayLike | None = None,
    numbers_of_ids: dict[str, int] | None = None,
) -> Boxes:
    """Convert annotations (`sample_annotation`) or results to boxes.

    Args:
        records: of one sample. The label is taken from `detection_name`, `tracking_name` or `category_name`, the score
            from `detection_score` or `tracking_score`, each if all records have it.
        global_SE3_frame: (4, 4) pose of the frame of the result in that of the records, such as
            `SE3_from_nuscenes(ego_pose)`; None to stay in the frame of the records.
        numbers_of_ids: to take the ids over: the track id of each `tracking_id` or `instance_token`. Unknown ones get
            the next number and are added, so use one dict for all samples of a scene. None for boxes without ids.

    Returns:
        N upright boxes; roll and pitch in the frame of the result are dropped.

    Raises:
        ValueError: a malformed record, or a global_SE3_frame that is not rigid; the message names row and field.
    """
    poses, sizes = np.zeros((len(records), 4, 4)), np.zeros((len(records), 3))
    for row, record in enumerate(records):
        poses[row], sizes[row] = _pose_and_size(record, row)
    if global_SE3_frame is not None:
        poses = inverse_SE3(rigid_SE3(global_SE3_frame, "global_SE3_frame")) @ poses
    ids = None if numbers_of_ids is None else _values(records, _IDS)
    return Boxes(
        center=poses[:, :3, 3],
        size=sizes[:, [1, 0, 2]],
        yaw=upright_yaw(poses),
        score=_values(records, _SCORES),
        track_id=None
        if ids is None or numbers_of_ids is None
        else [numbers_of_ids.setdefault(str(token), len(numbers_of_ids)) for token in ids],
        label=_values(records, _LABELS),
    )


def nuscenes_from_boxes(boxes: Boxes, global_SE3_frame: ArrayLike | None = None) -> list[dict[str, Any]]:
    """Convert boxes to records, the inverse of `boxes_from_nuscenes`.

    Args:
        boxes: N boxes.
        global_SE3_frame: (4, 4) pose of the frame of the boxes in the global frame; None to stay in their frame.

    Returns:
        N dicts of `translation`, `size` and `rotation`; with track ids `tracking_id` (as text), `tracking_name` and
        `tracking_score`, otherwise `detection_name` and `detection_score`, where the boxes have labels and scores.
        `sample_token` and `velocity` of a submission are up to the caller.

    Raises:
        ValueError: global_SE3_frame is not rigid.
    """
    frame = np.eye(4) if global_SE3_frame is None else rigid_SE3(global_SE3_frame, "global_SE3_frame")
    centers = boxes.center @ frame[:3, :3].T + frame[:3, 3]
    turns = np.zeros((len(boxes), 3))
    turns[:, 2] = boxes.yaw
    rotations = (Rotation.from_matrix(frame[:3, :3]) * Rotation.from_rotvec(turns)).as_quat() if len(boxes) else turns
    task = "detection" if boxes.track_id is None else "tracking"
    records: list[dict[str, Any]] = []
    for row in range(len(boxes)):
        x, y, z, w = rotations[row].tolist()
        record: dict[str, Any] = {
            "translation": centers[row].tolist(),
            "size": boxes.size[row, [1, 0, 2]].tolist(),
            "rotation": [w, x, y, z],
        }
        if boxes.track_id is not None:
            record["tracking_id"] = str(boxes.track_id[row])
        if boxes.label is not None:
            record[f"{task}_name"] = str(boxes.label[row])
        if boxes.score is not None:
            record[f"{task}_score"] = float(boxes.score[row])
        records.append(record)
    return records


def _pose_and_size(record: Record, row: int) -> tuple[FloatArray, FloatArray]:
    try:
        return SE3_from_nuscenes(record), _numbers(record, "size", 3)
    except ValueError as error:
        raise ValueError(f"records: row {row}: {error}") from None


def _numbers(record: Record, field: str, count: int) -> FloatArray:
    if field not in record:
        raise ValueError(f"{field} is missing")
    try:
        values = np.asarray(record[field], dtype=np.float64)
    except (TypeError, ValueError):
        values = np.zeros(0)
    if values.shape != (count,) or not np.isfinite(values).all():
        raise ValueError(f"{field} must be {count} finite numbers, got {record[field]!r}")
    return values


def _values(records: Sequence[Record], names: tuple[str, ...]) -> list[Any] | None:
    """The values of the first of these fields that all records have; None without such a field or without records."""
    for name in names:
        if records and all(name in record for record in records):
            return [record[name] for record in records]
    return None
