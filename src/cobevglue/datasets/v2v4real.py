"""V2V4Real: two real cars, 10 Hz, poses with some error of their own.

The tree and the keys are OPV2V's, with these differences:

- `lidar_pose` is a 4x4 matrix, dumped as a numpy array.
- Objects are in the agent's own LiDAR frame, not in the world. The other car is among them.
- An object's id is the agent's own; `ass_id` is the common one, -1 where the object was not associated.
- `obj_type` says what it is; pedestrians are not part of the benchmark and are left out.

**Handedness.** The usual tools treat the data as left-handed (y to the right), a heritage of OPV2V, and the author of
the tracking files calls them so too. The data say otherwise: they were recorded in right-hand traffic (Columbus, Ohio),
and in the tracking labels nearly all cars that head towards the ego car pass it at positive y, while those overtaken or
parked at the roadside are passed at negative y (`tests/datasets/test_tracking_text.py` counts them). So y is to the
left, as everywhere in this package, and nothing is mirrored unless `left_handed` is asked for.
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
"""Whether V2V4Real's y axis is to the right; the text of this module says why not. The default of all its readers."""


class V2V4Real(YamlTree):
    """V2V4Real: `V2V4Real(root, split="test")[scenario]` is a sequence of frames with the agents "0" and "1"."""

    splits: ClassVar[tuple[str, ...]] = ("train", "validate", "test")

    def __init__(self, root: str | Path, split: str, left_handed: bool = LEFT_HANDED) -> None:
        """Look at which scenarios there are.

        Args:
            root: folder that holds the splits.
            split: name of the split's folder.
            left_handed: take the files as having y to the right, and mirror them (see the module's text).

        Raises:
            FileNotFoundError: there is no such root, or the split is not in it; says what was looked for.
            ValueError: no split is called so (names the nearest), or `left_handed` is not a bool.
        """
        super().__init__(root, split)
        if not isinstance(left_handed, bool):  # it may be what a user typed, and any text is true
            raise ValueError(f"{type(self).__name__}: left_handed must be true or false, got {left_handed!r}")
        self.left_handed = left_handed

    def _label_reader(self, agent: str) -> LabelReader:
        return partial(read_v2v4real_labels_yaml, agent=agent, left_handed=self.left_handed)

    def _read_points(self, path: Path) -> Float32Array:
        # In `rgb` the intensity is as in OPV2V; a field `intensity` is taken as the sensor's own 0 to 255.
        return read_pcd(path, left_handed=self.left_handed, intensity_scale=1.0 / 255.0)


def read_v2v4real_labels_yaml(path: Path, agent: str, left_handed: bool = LEFT_HANDED) -> tuple[FloatArray, Boxes]:
    """Pose and objects in a yaml file of V2V4Real.

    Args:
        path: the file.
        agent: name of the agent's folder, "0" or "1".
        left_handed: the file has y to the right: mirror it.

    Returns:
        world_SE3_lidar (4, 4), a proper rotation, and the objects in the LiDAR frame. The id of an object is its
        `ass_id`; one without gets a negative id from its own id and the agent, so that it never equals another's.

    Raises:
        FileNotFoundError: the file is not there.
        ValueError: it is broken; names the file, the object and the field.
    """
    lidar_pose, table = read_objects(path, skip_kinds=("pedestrian",))
    world_SE3_lidar = rigid_SE3(lidar_pose, f"{path}: lidar_pose")
    center, yaw = table.pose[:, :3], np.deg2rad(table.pose[:, 4])
    if left_handed:
        world_SE3_lidar, center, yaw = mirrored(world_SE3_lidar), center * [1.0, -1.0, 1.0], -yaw
    # Roll and pitch are in the LiDAR frame itself: set upright, a box keeps its yaw.
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
                "without it an object that both observe would count as two"
            )
    return [entry["ass_id"] for entry in table.entries]


def _common_ids(own: list[int], associated: list[int], agent: int) -> list[int]:
    """Ids that are the same for both agents where an object is associated, and unique otherwise.

    The data set's own loader uses id + 100 x agent for the rest, which meets real ids: there are more than 100 objects.
    """
    ids: list[int] = []
    for own_id, common_id in zip(own, map(int, associated), strict=True):
        free = common_id >= 0 and common_id not in ids  # a second object with the same association keeps its own id
        ids.append(common_id if free else -(10 * abs(own_id) + agent + 1))
    return ids
