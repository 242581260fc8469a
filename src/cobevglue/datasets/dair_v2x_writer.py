"""Writer of frames in DAIR-V2X-C's format."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.datasets.atomic_files import write_json
from cobevglue.datasets.pcd import write_pcd_intensity
from cobevglue.datasets.poses import rigid_SE3, transform_boxes
from cobevglue.typing import ArrayLike, FloatArray

__all__ = ["DAIRPair", "DAIRSide", "dair_v2x_frame_files", "write_dair_v2x_frame", "write_dair_v2x_index"]

_CAR, _UNIT, _COMMON = "vehicle-side", "infrastructure-side", "cooperative"
_OWN_LABELS = MappingProxyType(
    {_CAR: ("label/lidar", "label/lidar_backup"), _UNIT: ("label/virtuallidar",), _COMMON: ()}
)
_COMMON_LABELS = ("label_world_backup", "label_world")  # the last one is written last of all files of a frame
_TYPES = MappingProxyType({"van": "Van", "truck": "Truck", "bus": "Bus", "motorcycle": "Motorcyclist"})
"""DAIR-V2X's types by label; all others are cars."""
_EPOCH = 1_600_000_000_000_000
"""Origin of the time stamps of clouds [us]."""


class DAIRPair(NamedTuple):
    """A pair of clouds of the car and the roadside unit.

    Attributes:
        frame: name of the files of both, digits.
        batch: name of the recording.
        time: since the start of the recording [s].
    """

    frame: str
    batch: str
    time: float


@dataclass(frozen=True, eq=False)
class DAIRSide:
    """Data of the car or the roadside unit in one frame.

    Attributes:
        world_SE3_lidar: (4, 4) pose of its LiDAR.
        objects: the labelled objects visible to it, in its LiDAR frame.
        points: (N, 4) x, y, z [m], intensity [0, 1] in its LiDAR frame; None to store no cloud.
    """

    world_SE3_lidar: ArrayLike
    objects: Boxes
    points: ArrayLike | None = None


def dair_v2x_frame_files(root: str | Path, frame: str, with_points: bool = True) -> list[Path]:
    """All files of a frame; the last one is written last."""
    root = Path(root)
    calibration = [(_CAR, "novatel_to_world"), (_CAR, "lidar_to_novatel"), (_UNIT, "virtuallidar_to_world")]
    names = [f"{side}/velodyne/{frame}.pcd" for side in (_CAR, _UNIT) if with_points]
    names += [f"{side}/calib/{what}/{frame}.json" for side, what in calibration]
    names += [f"{side}/{folder}/{frame}.json" for side in (_CAR, _UNIT) for folder in _OWN_LABELS[side]]
    names += [f"{_COMMON}/{folder}/{frame}.json" for folder in _COMMON_LABELS]
    return [root / name for name in names]


def write_dair_v2x_frame(
    root: str | Path, frame: str, vehicle: DAIRSide, infrastructure: DAIRSide, common: Boxes
) -> None:
    """Write one frame of the car and the roadside unit, without the index (see `write_dair_v2x_index`).

    The inverse of `DAIRV2X`, which reads poses and objects to floating-point precision, points exactly and intensities
    to 8 bits; labels are converted to DAIR-V2X's types, ids are not stored. Complemented and original labels are equal.
    The car's position is that of its LiDAR, and the offset of the roadside unit is zero. Files are written atomically.

    Args:
        root: the folder with `vehicle-side`, `infrastructure-side` and `cooperative`; created if missing.
        frame: name of the files, digits.
        vehicle: data of the car.
        infrastructure: data of the roadside unit.
        common: the objects visible to either, without the car itself, in the car's LiDAR frame.

    Raises:
        ValueError: a pose is not rigid, the frame is not a number, or points are malformed.
    """
    root = Path(root)
    if not (frame.isascii() and frame.isdigit()):
        raise ValueError(f"frame must be digits, like '015438', got {frame!r}")
    sides = {_CAR: vehicle, _UNIT: infrastructure}
    poses = {side: rigid_SE3(sides[side].world_SE3_lidar, f"{side}: world_SE3_lidar") for side in sides}
    for side, data in sides.items():
        if data.points is not None:
            write_pcd_intensity(root / side / "velodyne" / f"{frame}.pcd", data.points)
    write_json(root / _CAR / "calib" / "novatel_to_world" / f"{frame}.json", _calibration(poses[_CAR]))
    write_json(root / _CAR / "calib" / "lidar_to_novatel" / f"{frame}.json", {"transform": _calibration(np.eye(4))})
    write_json(
        root / _UNIT / "calib" / "virtuallidar_to_world" / f"{frame}.json",
        _calibration(poses[_UNIT]) | {"relative_error": {"delta_x": 0.0, "delta_y": 0.0}},
    )
    for side, data in sides.items():
        for folder in _OWN_LABELS[side]:
            write_json(root / side / folder / f"{frame}.json", _labels(data.objects))
    common_labels = _common_labels(common, poses[_CAR])
    for folder in _COMMON_LABELS:
        write_json(root / _COMMON / folder / f"{frame}.json", common_labels)


def write_dair_v2x_index(root: str | Path, split: str, pairs: Sequence[DAIRPair]) -> None:
    """Add frames to the index files: `data_info.json` of both sides and of pairs, and `<split>.json`.

    Entries of other frames are kept.

    Raises:
        ValueError: an existing index file is malformed; the message names it.
    """
    root = Path(root)
    cars, units, both = [], [], []
    for pair in pairs:
        stamp = str(_EPOCH + round(pair.time * 1e6))
        image, cloud = f"image/{pair.frame}.jpg", f"velodyne/{pair.frame}.pcd"
        times = {"image_timestamp": stamp, "pointcloud_timestamp": stamp, "batch_id": pair.batch}
        side = {"image_path": image, "pointcloud_path": cloud, **times}
        cars.append(
            side
            | {
                "calib_novatel_to_world_path": f"calib/novatel_to_world/{pair.frame}.json",
                "calib_lidar_to_novatel_path": f"calib/lidar_to_novatel/{pair.frame}.json",
                "label_lidar_std_path": f"label/lidar/{pair.frame}.json",
            }
        )
        units.append(
            side
            | {
                "calib_virtuallidar_to_world_path": f"calib/virtuallidar_to_world/{pair.frame}.json",
                "label_lidar_std_path": f"label/virtuallidar/{pair.frame}.json",
            }
        )
        both.append(
            {
                "vehicle_image_path": f"{_CAR}/{image}",
                "vehicle_pointcloud_path": f"{_CAR}/{cloud}",
                "infrastructure_image_path": f"{_UNIT}/{image}",
                "infrastructure_pointcloud_path": f"{_UNIT}/{cloud}",
                "cooperative_label_path": f"{_COMMON}/label_world/{pair.frame}.json",
                "system_error_offset": {"delta_x": 0.0, "delta_y": 0.0},
            }
        )
    _merge(root / _CAR / "data_info.json", "pointcloud_path", cars)
    _merge(root / _UNIT / "data_info.json", "pointcloud_path", units)
    _merge(root / _COMMON / "data_info.json", "vehicle_pointcloud_path", both)
    path = root / f"{split}.json"
    write_json(path, sorted({*map(str, _list(path)), *(pair.frame for pair in pairs)}))


def _merge(path: Path, key: str, entries: Sequence[dict[str, Any]]) -> None:
    """Add entries to a JSON list, replacing those with the same value of `key`."""
    try:
        known = {str(entry[key]): entry for entry in _list(path)}
    except (TypeError, KeyError):
        raise ValueError(f"{path}: must be a list of objects with {key}") from None
    known |= {entry[key]: entry for entry in entries}
    write_json(path, [known[name] for name in sorted(known)], indent=1)


def _list(path: Path) -> list[Any]:
    if not path.is_file():
        return []
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: not readable as JSON: {error}") from None
    if not isinstance(content, list):
        raise ValueError(f"{path}: must be a list")
    return content


def _calibration(matrix: FloatArray) -> dict[str, Any]:
    return {"rotation": matrix[:3, :3].tolist(), "translation": matrix[:3, 3:].tolist()}


def _labels(objects: Boxes) -> list[dict[str, Any]]:
    """The labels of one side; fields of the image are 0."""
    kinds = ["car"] * len(objects) if objects.label is None else objects.label.tolist()
    return [
        {
            "type": _TYPES.get(kinds[row], "Car"),
            "occluded_state": 0,
            "truncated_state": 0,
            "2d_box": {"xmin": 0, "ymin": 0, "xmax": 0, "ymax": 0},
            "3d_dimensions": dict(zip("lwh", objects.size[row].tolist(), strict=True)),
            "3d_location": dict(zip("xyz", objects.center[row].tolist(), strict=True)),
            "rotation": float(objects.yaw[row]),
        }
        for row in range(len(objects))
    ]


def _common_labels(common: Boxes, world_SE3_ego: FloatArray) -> list[dict[str, Any]]:
    """The labels in the world frame, with the eight corners in the order of `DAIRV2X`."""
    around = np.array([[1, 1], [1, -1], [-1, -1], [-1, 1]]) / 2
    unit = np.array([[x, y, z] for z in (-0.5, 0.5) for x, y in around])
    c, s = np.cos(common.yaw), np.sin(common.yaw)
    turn = np.zeros((len(common), 3, 3))
    turn[:, 0, 0], turn[:, 0, 1], turn[:, 1, 0], turn[:, 1, 1], turn[:, 2, 2] = c, -s, s, c, 1.0
    corners = np.einsum("nij,nkj->nki", turn, unit * common.size[:, None]) + common.center[:, None]
    corners = corners @ world_SE3_ego[:3, :3].T + world_SE3_ego[:3, 3]
    labels = _labels(transform_boxes(common, world_SE3_ego))
    return [label | {"world_8_points": eight.tolist()} for label, eight in zip(labels, corners, strict=True)]
