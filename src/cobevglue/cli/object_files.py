"""Object lists from files and folders, paired frame by frame."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from cobevglue.boxes import Boxes
from cobevglue.datasets.opv2v import read_opv2v_labels
from cobevglue.messages.object_list import read_object_list
from cobevglue.tracking import Sort

__all__ = ["FramePair", "read_boxes", "read_pairs"]

_PERIOD = 0.1  # between frames of a folder [s]
_JSON, _YAML = {".json"}, {".yaml", ".yml"}


@dataclass(frozen=True, eq=False, slots=True)
class FramePair:
    """Object lists of two agents in one frame.

    Attributes:
        name: of the frame: the file name without extension.
        time: time stamp [s].
        ego: boxes in the ego's frame.
        other: boxes in the other's frame.
    """

    name: str
    time: float
    ego: Boxes
    other: Boxes


def read_boxes(path: Path) -> Boxes:
    """The boxes of an object list (`.json`) or of a frame of OPV2V (`.yaml`), in their own agent's frame.

    Raises:
        ValueError: invalid content or another file extension; the message names the file.
        OSError: the file cannot be read.
    """
    if path.suffix.lower() in _JSON:
        return read_object_list(path)
    if path.suffix.lower() in _YAML:
        return read_opv2v_labels(path)[1]  # without lidar_pose, which aligners must not receive
    raise ValueError(f"{path}: an object list ends with .json, a frame of OPV2V with .yaml")


def read_pairs(ego: Path, other: Path) -> tuple[list[FramePair], list[str]]:
    """Read one pair of files, or pair the frames of two folders by name.

    In folders, the union of the frame names in both, in order, has a period of 0.1 s; a frame without a file of one
    agent is a gap. Boxes without track ids are tracked.

    Args:
        ego: a file or a folder of the ego.
        other: a file or a folder of the other agent.

    Returns:
        The pairs in order, at least one, and notes for the user.

    Raises:
        ValueError: invalid content of a file, a file together with a folder, or no frame in both folders.
        OSError: a file cannot be read.
    """
    if not ego.is_dir() and not other.is_dir():
        return [FramePair(_pair_name(ego, other), 0.0, read_boxes(ego), read_boxes(other))], []
    for one, two in ((ego, other), (other, ego)):
        if not one.is_dir():
            one.stat()  # raises if the file does not exist
            raise ValueError(f"{one} is a file, but {two} is a folder: give two files or two folders")
    ego_files, other_files = _frames(ego), _frames(other)
    names = sorted(ego_files.keys() | other_files.keys(), key=_frame_order)
    common = [name for name in names if name in ego_files and name in other_files]
    if not common:
        raise ValueError(f"no frame of {ego} has a partner of the same name in {other}")
    times = {name: index * _PERIOD for index, name in enumerate(names)}
    ego_boxes, other_boxes = _tracked(ego_files, times), _tracked(other_files, times)
    pairs = [FramePair(name, times[name], ego_boxes[name], other_boxes[name]) for name in common]
    alone = len(names) - len(common)
    return pairs, [f"{alone} of {len(names)} frames have no partner and are skipped"] if alone else []


def _pair_name(ego: Path, other: Path) -> str:
    return ego.stem if ego.stem == other.stem else f"{ego.stem}, {other.stem}"


def _frames(folder: Path) -> dict[str, Path]:
    """Object lists and OPV2V frames (names of digits only) of a folder by name."""
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        kind = path.suffix.lower()
        if kind in _JSON or (kind in _YAML and path.stem.isdecimal()):
            if path.stem in found:
                raise ValueError(f"{path}: there is {found[path.stem].name} of the same name, too")
            found[path.stem] = path
    if not found:
        raise ValueError(f"{folder}: no object lists (.json) and no frames of OPV2V (<number>.yaml)")
    return found


def _frame_order(name: str) -> tuple[bool, int, str]:
    """Sort key: numeric order, then other names; frame 9 is before frame 10."""
    is_number = name.isdecimal()
    return not is_number, int(name) if is_number else 0, name


def _tracked(files: dict[str, Path], times: dict[str, float]) -> dict[str, Boxes]:
    """Boxes of all frames by name; tracked, unless all have track ids."""
    frames = {name: read_boxes(files[name]) for name in times if name in files}
    if all(boxes.track_id is not None for boxes in frames.values() if len(boxes)):
        return frames
    tracker = Sort()
    return {name: tracker.update(boxes, times[name]) for name, boxes in frames.items()}
