"""Common folder structure of OPV2V, V2XSet and V2V4Real: split / scenario / agent / timestamp.{yaml,pcd}."""

from __future__ import annotations

import itertools
import os
from collections import Counter
from collections.abc import Callable, Collection, Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.datasets.frame import AgentFrame, Dataset, Frame, Scenario, did_you_mean
from cobevglue.datasets.safe_yaml import read_yaml
from cobevglue.typing import ArrayLike, Float32Array, FloatArray

__all__ = ["ObjectTable", "YamlTree", "check_timestamp", "read_objects"]

LabelReader = Callable[[Path], tuple[FloatArray, Boxes]]


class YamlTree(Dataset):
    """A split of a data set in OPV2V's folder structure; base of `OPV2V`, `V2XSet` and `V2V4Real`.

    Attributes:
        root: folder that contains the splits.
        split: name of the split.
    """

    splits: ClassVar[tuple[str, ...]] = ()
    """The published splits; any other folder of this structure is accepted, too."""

    def __init__(self, root: str | Path, split: str) -> None:
        """List the scenarios, without opening files.

        Args:
            root: folder that contains the splits.
            split: name of the split's folder.

        Raises:
            FileNotFoundError: the root or the split does not exist; the message names the expected path.
            ValueError: unknown split; the message suggests the most similar one.
        """
        self.root, self.split = Path(root), split
        if not self.root.is_dir():
            raise FileNotFoundError(f"{type(self).__name__}: no folder {self.root}")
        folder = self.root / split
        if not split or not folder.is_dir():
            present = _subfolders(self.root)
            if split not in self.splits:
                raise ValueError(f"{type(self).__name__}: no split {did_you_mean(split, {*self.splits, *present})}")
            raise FileNotFoundError(
                f"{type(self).__name__}: looked for {folder}/<scenario>/<agent>/<timestamp>.yaml, but {self.root} "
                f"holds {', '.join(present[:8]) or 'no folders'}"
            )
        self.scenarios = tuple(name for name in _subfolders(folder) if _subfolders(folder / name))
        if not self.scenarios:
            raise FileNotFoundError(
                f"{type(self).__name__}: {folder} holds no <scenario>/<agent>/<timestamp>.yaml; wrong root?"
            )

    def __repr__(self) -> str:
        return f"{type(self).__name__}({str(self.root)!r}, split={self.split!r})"

    @property
    def cloud_location(self) -> str:
        """Expected location of the clouds, for error messages."""
        return f"{self.root / self.split}/<scenario>/<agent>/<timestamp>.pcd"

    def _label_reader(self, agent: str) -> LabelReader:
        """The reader of the yaml files of this agent."""
        raise NotImplementedError

    def _read_points(self, path: Path) -> Float32Array:
        raise NotImplementedError

    def _scenario(self, name: str) -> Scenario:
        folder = self.root / self.split / name
        listing = {agent: _timestamps(folder / agent) for agent in _subfolders(folder)}
        # Vehicles first: the first agent is the default ego, and roadside units (negative ids) are never the ego.
        listing = {agent: listing[agent] for agent in sorted(listing, key=lambda a: (a.startswith("-"), a))}
        timestamps = sorted(set().union(*listing.values()), key=lambda stamp: (int(stamp), stamp))
        if not timestamps:
            raise FileNotFoundError(f"{folder} holds no <agent>/<timestamp>.yaml")
        times = _seconds([int(stamp) for stamp in timestamps])

        def make_frame(index: int) -> Frame:
            stamp = timestamps[index]
            agents = {
                agent: AgentFrame(
                    read_labels=partial(self._label_reader(agent), folder / agent / f"{stamp}.yaml"),
                    read_points=partial(self._read_points_if_any, folder / agent / f"{stamp}.pcd"),
                    is_infrastructure=agent.startswith("-"),
                )
                for agent, stamps in listing.items()
                if stamp in stamps
            }
            return Frame(scenario=name, timestamp=stamp, time=times[index], agents=agents)

        return Scenario(name, len(timestamps), make_frame)

    def _read_points_if_any(self, path: Path) -> Float32Array | None:
        return self._read_points(path) if path.is_file() else None


def check_timestamp(timestamp: str) -> None:
    """Validate the name of a frame.

    Raises:
        ValueError: it is not all digits.
    """
    if not _is_timestamp(timestamp):
        raise ValueError(f"timestamp must be digits, like '000068', got {timestamp!r}")


class ObjectTable:
    """The `vehicles` of a yaml file as validated columns.

    Attributes:
        ids: (N,) ids of the objects.
        pose: (N, 6) x, y, z [m] of the box centre, roll, yaw, pitch [degrees], in the frame and axes of the file.
        size: (N, 3) length, width, height [m].
        kinds: (N,) lower-case type; "car" if the file has none.
        entries: (N,) the raw mappings.
    """

    def __init__(self, path: Path, vehicles: Any, skip_kinds: Collection[str] = ()) -> None:
        """Parse the objects without `skip_kinds` and those of zero length or width (two-wheelers of CARLA).

        Raises:
            ValueError: a value is missing, not a number, not finite or a negative extent; the message names file,
                object and field.
        """
        if vehicles is not None and not isinstance(vehicles, Mapping):
            raise ValueError(f"{path}: vehicles must be a mapping from object id, got {type(vehicles).__name__}")
        self.ids: list[int] = []
        self.kinds: list[str] = []
        self.entries: list[Mapping[str, Any]] = []
        pose, size = [], []
        for key, entry in (vehicles or {}).items():
            where = f"{path}: vehicles.{key}"
            if not isinstance(entry, Mapping):
                raise ValueError(f"{where} must be a mapping, got {type(entry).__name__}")
            # The key is `object_type` in RCooper and V2X-Real, converted to this format.
            kind = str(entry.get("obj_type") or entry.get("object_type") or "car").lower()
            if kind in skip_kinds:
                continue
            extent = _triple(where, entry, "extent")
            if (extent < 0).any():
                raise ValueError(f"{where}.extent is negative: {extent.tolist()}")
            if (extent[:2] == 0).any():
                continue
            self.ids.append(_object_id(where, key))
            self.kinds.append(kind)
            self.entries.append(entry)
            # The offset of the box centre is added in the axes of the location, not rotated with the object, as in
            # other readers of these data; it has almost no horizontal component.
            centre = _triple(where, entry, "location") + _triple(where, entry, "center")
            pose.append(np.concatenate([centre, _triple(where, entry, "angle")]))
            size.append(2.0 * extent)
        self.pose: FloatArray = np.array(pose, dtype=np.float64).reshape(-1, 6)
        self.size: FloatArray = np.array(size, dtype=np.float64).reshape(-1, 3)


def read_objects(path: Path, skip_kinds: Collection[str] = ()) -> tuple[ArrayLike, ObjectTable]:
    """Read the raw `lidar_pose` and the objects of a yaml file.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: it is malformed; the message names the file and the field.
    """
    document = read_yaml(path, keys=("lidar_pose", "vehicles"))
    for key in ("lidar_pose", "vehicles"):
        if key not in document:
            raise ValueError(f"{path}: no {key}")
    return document["lidar_pose"], ObjectTable(path, document["vehicles"], skip_kinds)


def _object_id(where: str, key: Any) -> int:
    if isinstance(key, int) or (isinstance(key, str) and key.lstrip("-").isdecimal()):
        return int(key)
    raise ValueError(f"{where}: an object id must be an integer")


def _triple(where: str, entry: Mapping[str, Any], field: str) -> FloatArray:
    if field not in entry:
        raise ValueError(f"{where} has no {field}")
    try:
        values = np.asarray(entry[field], dtype=np.float64)
    except (TypeError, ValueError):
        raise ValueError(f"{where}.{field} must be three numbers, got {entry[field]!r}") from None
    if values.shape != (3,) or not np.isfinite(values).all():
        raise ValueError(f"{where}.{field} must be three finite numbers, got {values.tolist()}")
    return values


def _seconds(numbers: list[int]) -> list[float]:
    """Convert file numbers of a recording at 10 Hz to seconds since the first one.

    OPV2V numbers by simulation ticks of 0.05 s and keeps every second one; V2V4Real counts frames. The step is
    therefore estimated as the most frequent difference, and a missing frame is a gap in time.
    """
    steps = Counter(later - earlier for earlier, later in itertools.pairwise(numbers) if later > earlier)
    step = min(steps, key=lambda value: (-steps[value], value)) if steps else 1
    return [(number - numbers[0]) / step / 10.0 for number in numbers]


def _subfolders(folder: Path) -> list[str]:
    with os.scandir(folder) as entries:
        return sorted(entry.name for entry in entries if entry.is_dir() and not entry.name.startswith("."))


def _is_timestamp(stem: str) -> bool:
    return stem.isascii() and stem.isdigit()


def _timestamps(folder: Path) -> frozenset[str]:
    """Names of the frames of an agent; other yaml files (`additional`, `camera_gt`) are ignored."""
    with os.scandir(folder) as entries:
        stems = (entry.name.removesuffix(".yaml") for entry in entries if entry.name.endswith(".yaml"))
        return frozenset(stem for stem in stems if _is_timestamp(stem))
