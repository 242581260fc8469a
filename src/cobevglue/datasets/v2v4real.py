"""V2V4Real: two real cars, 10 Hz, poses with localisation errors.

Folder structure and keys are those of OPV2V, with these differences:

- `lidar_pose` is a 4x4 matrix, dumped as a numpy array.
- Objects are in the agent's own LiDAR frame, not in the world frame. The other car is among them.
- The object id is specific to the agent; `ass_id` is common to both, -1 if the object was not associated.
- `obj_type` is the class; pedestrians are not part of the benchmark and are omitted.

**Handedness.** The usual tools treat the data as left-handed (y to the right), as in OPV2V, and so does the author of
the tracking files. The data contradict this: they were recorded in right-hand traffic (Columbus, Ohio), and in the
tracking labels nearly all oncoming cars pass the ego car at positive y, while those overtaken or parked at the roadside
are passed at negative y (`tests/datasets/test_tracking_text.py` counts them). So y is to the left, as everywhere in
this package, and nothing is mirrored unless `left_handed` is set.
"""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import ClassVar

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.datasets.pcd import read_pcd
from cobevglue.datasets.poses import mirrored, rigid_SE3
from cobevglue.datasets.yaml_tree import LabelReader, ObjectTable, YamlTree, read_objects
from cobevglue.typing import Float32Array, FloatArray

__all__ = ["LEFT_HANDED", "V2V4Real", "read_v2v4real_labels_yaml"]

LEFT_HANDED = False
"""Whether V2V4Real's y axis points to the right (see the module docstring). The default of all its readers."""


class V2V4Real(YamlTree):
    """V2V4Real: `V2V4Real(root, split="test")[scenario]` is a sequence of frames with the agents "0" and "1"."""

    splits: ClassVar[tuple[str, ...]] = ("train", "validate", "test")

    def __init__(self, root: str | Path, split: str, left_handed: bool = LEFT_HANDED) -> None:
        """List the scenarios.

        Args:
            root: folder that contains the splits.
            split: name of the split's folder.
            left_handed: the y axis of the files points to the right; it is mirrored (see the module docstring).

        Raises:
            FileNotFoundError: the root or the split does not exist; the message names the expected path.
            ValueError: unknown split (the message suggests the most similar one), or `left_handed` is not a bool.
        """
        super().__init__(root, split)
        if not isinstance(left_handed, bool):  # it may come from the command line, and any string is true
            raise ValueError(f"{type(self).__name__}: left_handed must be true or false, got {left_handed!r}")
        self.left_handed = left_handed

    def _label_reader(self, agent: str) -> LabelReader:
        return partial(read_v2v4real_labels_yaml, agent=agent, left_handed=self.left_handed)

    def _read_points(self, path: Path) -> Float32Array:
        # The intensity in `rgb` is as in OPV2V; a field `intensity` is assumed to be raw, 0 to 255.
        return read_pcd(path, left_handed=self.left_handed, intensity_scale=1.0 / 255.0)


def read_v2v4real_labels_yaml(path: Path, agent: str, left_handed: bool = LEFT_HANDED) -> tuple[FloatArray, Boxes]:
    """Read pose and objects from a yaml file of V2V4Real.

    Args:
        path: the file.
        agent: name of the agent's folder, "0" or "1".
        left_handed: the y axis of the file points to the right; it is mirrored.

    Returns:
        world_SE3_lidar (4, 4), and the objects in the LiDAR frame. The id of an object is its `ass_id`; objects that
        are not associated get a unique negative id from their own id and the agent.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: it is malformed; the message names the file, the object and the field.
    """
    lidar_pose, table = read_objects(path, skip_kinds=("pedestrian",))
    world_SE3_lidar = rigid_SE3(lidar_pose, f"{path}: lidar_pose")
    center, yaw = table.pose[:, :3], np.deg2rad(table.pose[:, 4])
    if left_handed:
        world_SE3_lidar, center, yaw = mirrored(world_SE3_lidar), center * [1.0, -1.0, 1.0], -yaw
    # Roll and pitch are relative to the LiDAR frame, so the yaw does not change when they are dropped.
    try:
        ids = _common_ids(table.ids, _associations(path, table), int(agent))
        boxes = Boxes(center=center, size=table.size, yaw=yaw, track_id=ids, label=table.kinds)
    except (TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{path}: vehicles: {error}") from None
    return world_SE3_lidar, boxes


def _associations(path: Path, table: ObjectTable) -> list[int]:
    """`ass_id` of each object."""
    for own_id, entry in zip(table.ids, table.entries, strict=True):
        if "ass_id" not in entry:
            raise ValueError(
                f"{path}: vehicles.{own_id} has no ass_id, the id that is common to both agents (-1: not associated); "
                "without it an object observed by both would be counted twice"
            )
    return [entry["ass_id"] for entry in table.entries]


def _common_ids(own: list[int], associated: list[int], agent: int) -> list[int]:
    """Ids that are the same for both agents if an object is associated, and unique otherwise.

    The data set's own loader uses id + 100 x agent for the rest, which is not unique with more than 100 objects.
    """
    ids: list[int] = []
    for own_id, common_id in zip(own, map(int, associated), strict=True):
        free = common_id >= 0 and common_id not in ids  # a second object with the same association keeps its own id
        ids.append(common_id if free else -(10 * abs(own_id) + agent + 1))
    return ids
