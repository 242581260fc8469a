"""DAIR-V2X-C: a real car and a roadside unit at 28 intersections; right-handed, so nothing is mirrored.

Properties of the data that are handled here:

- The roadside unit's calibration has errors; each pair has a `system_error_offset` to add to its translation (or "").
- There are two sets of labels. The complemented ones (Lu et al.) cover 360 degrees and are installed over the original
  ones, which are first renamed to `label_world_backup` and `lidar_backup`.
- Cooperative labels are in the world frame; according to the manual, only their eight corners are reliable.
- Numbers may be strings, boxes may have no size (omitted), and clouds may be missing (`points` is None).
- There are no object ids, so `track_id` is None: no ground truth for tracking or matching.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Iterable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.datasets.frame import AgentFrame, Dataset, Frame, Scenario, did_you_mean
from cobevglue.datasets.pcd import read_bin, read_pcd
from cobevglue.datasets.poses import inverse_SE3, rigid_SE3
from cobevglue.typing import Float32Array, FloatArray

__all__ = ["DAIRV2X"]

VEHICLES = ("car", "van", "truck", "bus")
"""The classes that the benchmark evaluates, all as "car"."""


class DAIRV2X(Dataset):
    """DAIR-V2X-C: `DAIRV2X(root, split="val")[batch]` is a sequence of frames of "vehicle" and "infrastructure".

    A scenario is a batch, one continuous recording of the car. A frame is a pair of clouds some ten milliseconds apart;
    `Frame.time` is that of the car's cloud, and its name is the id of the car's files.
    """

    validation_split: ClassVar[str] = "val"

    def __init__(
        self,
        root: str | Path,
        split: str,
        *,
        labels: Literal["complemented", "original"] = "complemented",
        classes: Collection[str] = VEHICLES,
        split_file: str | Path | None = None,
    ) -> None:
        """Read the index files.

        Args:
            root: the folder `cooperative-vehicle-infrastructure`, or its parent.
            split: name of the split.
            labels: "complemented" for the labels of Lu et al., "original" for those of the first release.
            classes: types of objects to keep, case-insensitive.
            split_file: JSON list of the car's frame ids, or the official `cooperative-split-data.json`. By default,
                `<split>.json` or that name, in `root` or its parent. Ids without a pair are skipped (the official
                test split is not published).

        Raises:
            FileNotFoundError: a file or folder is missing; the message names the expected path.
            ValueError: unknown split or labels, `classes` is a string, or a malformed file; the message names it and
                the field.
        """
        if isinstance(classes, str) or not isinstance(classes, Collection):
            raise ValueError(f"DAIRV2X: classes must be a list of types, like [car, bus], got {classes!r}")
        given = Path(root)
        nested = given / "cooperative-vehicle-infrastructure"
        self.root, self.split = nested if nested.is_dir() else given, split
        self.classes = frozenset(str(kind).lower() for kind in classes)
        if not (self.root / "cooperative" / "data_info.json").is_file():
            raise FileNotFoundError(f"DAIRV2X: looked for {self.root / 'cooperative' / 'data_info.json'}")
        self._label_folders = _label_folders(self.root, labels)
        wanted = _split_ids(self.root, split, split_file)
        recordings = _recordings(self.root / "vehicle-side" / "data_info.json")
        batches: dict[str, list[_Pair]] = {}
        for pair in _pairs(self.root / "cooperative" / "data_info.json"):
            if pair.vehicle in wanted:
                if pair.vehicle not in recordings:
                    raise ValueError(
                        f"{self.root / 'vehicle-side' / 'data_info.json'}: no entry for {pair.vehicle}.pcd"
                    )
                batch, pair.microseconds = recordings[pair.vehicle]
                batches.setdefault(batch, []).append(pair)
        if not batches:
            raise ValueError(f"DAIRV2X: none of the {len(wanted)} frames of split {split!r} is a pair in {self.root}")
        self._batches = {name: sorted(batches[name], key=lambda p: (p.microseconds, p.vehicle)) for name in batches}
        self.scenarios = tuple(sorted(batches, key=lambda name: (len(name), name)))  # 9 before 10

    def __repr__(self) -> str:
        return f"DAIRV2X({str(self.root)!r}, split={self.split!r})"

    @property
    def cloud_location(self) -> str:
        """Expected location of the clouds, for error messages."""
        sides = self.root / "vehicle-side", self.root / "infrastructure-side"
        folders = [folder for side in sides for folder in _cloud_folders(side)]
        return "<frame>.pcd or .bin in " + ", ".join(map(str, folders))

    def _scenario(self, name: str) -> Scenario:
        pairs = self._batches[name]

        def make_frame(index: int) -> Frame:
            pair = pairs[index]
            car, unit = self.root / "vehicle-side", self.root / "infrastructure-side"
            car_labels, common_labels = (folder / f"{pair.vehicle}.json" for folder in self._label_folders)
            unit_labels = unit / "label" / "virtuallidar" / f"{pair.infrastructure}.json"
            return Frame(
                scenario=name,
                timestamp=pair.vehicle,
                time=(pair.microseconds - pairs[0].microseconds) / 1e6,
                agents={
                    "vehicle": AgentFrame(
                        read_labels=partial(_vehicle, car, pair.vehicle, car_labels, self.classes),
                        read_points=partial(_points, _cloud_folders(car), pair.vehicle),
                    ),
                    "infrastructure": AgentFrame(
                        read_labels=partial(_infrastructure, unit, pair, unit_labels, self.classes),
                        read_points=partial(_points, _cloud_folders(unit), pair.infrastructure),
                        is_infrastructure=True,
                    ),
                },
                read_common_objects=partial(_common_objects, common_labels, self.classes),
            )

        return Scenario(name, len(pairs), make_frame)


class _Pair:
    """One frame of the car and the associated frame of the roadside unit."""

    def __init__(self, vehicle: str, infrastructure: str, offset: tuple[float, float]) -> None:
        self.vehicle, self.infrastructure, self.offset = vehicle, infrastructure, offset
        self.microseconds = 0


def _label_folders(root: Path, labels: str) -> tuple[Path, Path]:
    """Folders of the car's own labels and of the cooperative ones."""
    if labels not in ("complemented", "original"):
        raise ValueError(f"DAIRV2X: no labels {did_you_mean(labels, ('complemented', 'original'))}")
    plain = root / "vehicle-side" / "label" / "lidar", root / "cooperative" / "label_world"
    backup = tuple(folder.with_name(f"{folder.name}_backup") for folder in plain)
    renamed = [folder.is_dir() for folder in backup]
    if any(renamed) and not all(renamed):
        present, absent = backup if renamed[0] else backup[::-1]
        raise FileNotFoundError(f"DAIRV2X: {present} exists but {absent} does not: complemented labels replace both")
    if labels == "complemented" and not all(renamed):
        raise FileNotFoundError(
            f"DAIRV2X: no {backup[1]}, so {plain[1]} are the original labels; complemented labels are installed "
            "there after renaming these to *_backup (or pass labels='original', as --dataset-option labels=original to "
            "a command)"
        )
    return (backup[0], backup[1]) if labels == "original" and all(renamed) else plain


def _split_ids(root: Path, split: str, split_file: str | Path | None) -> frozenset[str]:
    names = (f"{split}.json", "cooperative-split-data.json")
    candidates = [Path(split_file)] if split_file else [base / name for base in (root, root.parent) for name in names]
    path = next((candidate for candidate in candidates if candidate.is_file()), None)
    if path is None:
        looked = ", ".join(map(str, candidates))
        raise FileNotFoundError(f"DAIRV2X: no list of the frames of split {split!r}: looked for {looked}")
    content = _read_json(path)
    if isinstance(content, Mapping):
        splits = content.get("cooperative_split")
        if not isinstance(splits, Mapping):
            raise ValueError(f"{path}: no cooperative_split")
        if split not in splits:
            raise ValueError(f"{path}: no split {did_you_mean(split, splits)}")
        content = splits[split]
    if not isinstance(content, Sequence) or isinstance(content, str):
        raise ValueError(f"{path}: the frames of split {split!r} must be a list of ids")
    return frozenset(str(frame) for frame in content)


def _recordings(path: Path) -> dict[str, tuple[str, int]]:
    """Batch and time [us] of the car's clouds by frame id."""
    recordings = {}
    for row, entry in enumerate(_read_list(path)):
        time = _number(f"{path}: [{row}].pointcloud_timestamp", entry.get("pointcloud_timestamp"))
        recordings[_frame_id(path, row, entry, "pointcloud_path")] = (str(entry.get("batch_id", "all")), int(time))
    return recordings


def _pairs(path: Path) -> list[_Pair]:
    pairs = []
    for row, entry in enumerate(_read_list(path)):
        vehicle = _frame_id(path, row, entry, "vehicle_pointcloud_path")
        infrastructure = _frame_id(path, row, entry, "infrastructure_pointcloud_path")
        offset = entry.get("system_error_offset") or {}  # "" where the pair has no correction
        if not isinstance(offset, Mapping):
            raise ValueError(f"{path}: [{row}].system_error_offset must be delta_x and delta_y, got {offset!r}")
        where = f"{path}: [{row}].system_error_offset"
        dx, dy = (_number(f"{where}.{axis}", offset.get(axis, 0.0) or 0.0) for axis in ("delta_x", "delta_y"))
        pairs.append(_Pair(vehicle, infrastructure, (dx, dy)))
    return pairs


def _frame_id(path: Path, row: int, entry: Mapping[str, Any], field: str) -> str:
    value = entry.get(field)
    if value is None and "vehicle_frame" in entry:
        raise ValueError(
            f"{path}: [{row}] has vehicle_frame in place of {field}: this is V2X-Seq-SPD; only DAIR-V2X-C is read"
        )
    if not isinstance(value, str) or not value.endswith((".pcd", ".bin")):
        raise ValueError(f"{path}: [{row}].{field} must be the path of a .pcd or .bin file, got {value!r}")
    return Path(value).stem


def _cloud_folders(side: Path) -> tuple[Path, ...]:
    """Possible folders of the clouds of a side: in place, or of the unpacked archives, in or beside the root."""
    archive = f"cooperative-vehicle-infrastructure-{side.name}-velodyne"
    return side / "velodyne", side.parent / archive, side.parent.parent / archive


def _points(folders: Iterable[Path], frame: str) -> Float32Array | None:
    """Read the cloud of a frame, PCD or KITTI's .bin, from the first folder that contains it; None if none does."""
    for folder in folders:
        if (folder / f"{frame}.pcd").is_file():
            return read_pcd(folder / f"{frame}.pcd", intensity_scale=1.0 / 255.0)
        if (folder / f"{frame}.bin").is_file():
            return read_bin(folder / f"{frame}.bin")
    return None


def _vehicle(side: Path, frame: str, labels: Path, classes: Collection[str]) -> tuple[FloatArray, Boxes]:
    world_SE3_novatel = _calibration(side / "calib" / "novatel_to_world" / f"{frame}.json")
    novatel_SE3_lidar = _calibration(side / "calib" / "lidar_to_novatel" / f"{frame}.json")
    return world_SE3_novatel @ novatel_SE3_lidar, _own_objects(labels, classes)


def _infrastructure(side: Path, pair: _Pair, labels: Path, classes: Collection[str]) -> tuple[FloatArray, Boxes]:
    world_SE3_lidar = _calibration(side / "calib" / "virtuallidar_to_world" / f"{pair.infrastructure}.json")
    world_SE3_lidar[:2, 3] += pair.offset
    return world_SE3_lidar, _own_objects(labels, classes)


def _calibration(path: Path) -> FloatArray:
    """(4, 4) transform of a calibration file, with rotation and translation at the top level or in `transform`."""
    content = _read_json(path)
    content = content.get("transform", content) if isinstance(content, Mapping) else None
    if not isinstance(content, Mapping):
        raise ValueError(f"{path}: must have rotation and translation")
    matrix = np.eye(4)
    matrix[:3, :3] = _array(path, content, "rotation", (3, 3))
    matrix[:3, 3] = _array(path, content, "translation", (3,))
    return rigid_SE3(matrix, f"{path}: the transform")


def _array(path: Path, content: Mapping[str, Any], field: str, shape: tuple[int, ...]) -> FloatArray:
    """The numbers of a field, reshaped: translations are stored as columns, [[x], [y], [z]]."""
    try:
        return np.asarray(content[field], dtype=np.float64).reshape(shape)
    except KeyError:
        raise ValueError(f"{path}: no {field}") from None
    except (TypeError, ValueError):
        raise ValueError(f"{path}: {field} must be numbers of shape {shape}, got {content[field]!r}") from None


def _own_objects(path: Path, classes: Collection[str]) -> Boxes:
    """The labels of one side, in its own LiDAR frame; locations are box centres, rotation is yaw from x to y [rad]."""
    center, size, yaw, kinds = [], [], [], []
    for where, kind, entry in _entries(path, classes):
        dimensions = [_nested(where, entry, "3d_dimensions", axis) for axis in "lwh"]
        if min(dimensions) < 0:
            raise ValueError(f"{where}.3d_dimensions is negative: {dimensions}")
        if min(dimensions) > 0:  # some labels are in the image only and have no box
            center.append([_nested(where, entry, "3d_location", axis) for axis in "xyz"])
            size.append(dimensions)
            yaw.append(_number(f"{where}.rotation", entry.get("rotation")))
            kinds.append(kind)
    return Boxes(center=center, size=size, yaw=yaw, label=kinds)


def _common_objects(path: Path, classes: Collection[str], world_SE3_ego: FloatArray) -> Boxes:
    """The cooperative labels in an agent's LiDAR frame.

    The corners of a box are those of the bottom (front left, front right, rear right, rear left), then of the top.
    """
    corners, kinds = [], []
    for where, kind, entry in _entries(path, classes):
        try:
            points = np.asarray(entry.get("world_8_points"), dtype=np.float64)
        except (TypeError, ValueError):
            points = np.empty(0)
        if points.shape != (8, 3) or not np.isfinite(points).all():
            raise ValueError(f"{where}.world_8_points must be eight points of three finite numbers")
        corners.append(points)
        kinds.append(kind)
    ego_SE3_world = inverse_SE3(world_SE3_ego)
    p = np.array(corners, dtype=np.float64).reshape(-1, 8, 3) @ ego_SE3_world[:3, :3].T + ego_SE3_world[:3, 3]
    along = (p[:, [0, 1, 4, 5]] - p[:, [3, 2, 7, 6]]).mean(axis=1)
    across = (p[:, [0, 3, 4, 7]] - p[:, [1, 2, 5, 6]]).mean(axis=1)
    up = (p[:, 4:] - p[:, :4]).mean(axis=1)
    size = np.stack([np.linalg.norm(edge, axis=1) for edge in (along, across, up)], axis=-1)
    kept = (size > 0).all(axis=1)
    yaw = np.arctan2(along[:, 1], along[:, 0])
    return Boxes(
        center=p.mean(axis=1)[kept], size=size[kept], yaw=yaw[kept], label=np.array(kinds, dtype=np.str_)[kept]
    )


def _entries(path: Path, classes: Collection[str]) -> list[tuple[str, str, Mapping[str, Any]]]:
    """Location for error messages, lower-case type and content of the labels of these classes."""
    entries = []
    for row, entry in enumerate(_read_list(path)):
        kind = str(entry.get("type", "")).lower()
        if not kind:
            raise ValueError(f"{path}: [{row}] has no type")
        if kind in classes:
            entries.append((f"{path}: [{row}]", kind, entry))
    return entries


def _nested(where: str, entry: Mapping[str, Any], field: str, axis: str) -> float:
    values = entry.get(field)
    return _number(f"{where}.{field}.{axis}", values.get(axis) if isinstance(values, Mapping) else None)


def _number(where: str, value: Any) -> float:
    """Parse a finite number, which may be stored as a string."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise ValueError(f"{where} must be a number, got {value!r}") from None
    if not np.isfinite(number):
        raise ValueError(f"{where} must be finite, got {value!r}")
    return number


def _read_list(path: Path) -> list[Mapping[str, Any]]:
    content = _read_json(path)
    if not isinstance(content, list) or not all(isinstance(entry, Mapping) for entry in content):
        raise ValueError(f"{path}: must be a list of objects")
    return content


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8-sig"))  # editors on Windows add a byte-order mark
    except FileNotFoundError:
        raise FileNotFoundError(f"{path} does not exist") from None
    except (ValueError, RecursionError) as error:
        raise ValueError(f"{path}: not readable as JSON: {error}") from None
