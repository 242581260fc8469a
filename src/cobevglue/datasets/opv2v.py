"""OPV2V and V2XSet: simulated (CARLA, 10 Hz), with exact poses and object ids common to all agents of a scenario.

Both are left-handed on disk. A yaml file lists the objects with at least one point of its agent, in the world frame:
location, box centre offset, half extents and angle [roll, yaw, pitch]. Objects are transformed to the LiDAR frame of
their agent in three dimensions; then roll and pitch are dropped.
"""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from cobevglue.boxes import Boxes
from cobevglue.datasets.pcd import read_pcd
from cobevglue.datasets.poses import SE3_from_carla, SE3_from_lidar_pose, inverse_SE3, upright_yaw
from cobevglue.datasets.yaml_tree import LabelReader, YamlTree, read_objects
from cobevglue.typing import Float32Array, FloatArray

__all__ = ["OPV2V", "V2XSet", "read_opv2v_labels"]


class OPV2V(YamlTree):
    """OPV2V: `OPV2V(root, split="test_culvercity")["TwoCars_1"]` is a scenario, a sequence of frames.

    `root` contains the splits as folders, also those written by `cobevglue simulate`. Only folders are listed until the
    cloud, pose or objects of a frame are used.
    """

    splits: ClassVar[tuple[str, ...]] = ("train", "validate", "test", "test_culvercity")

    def _label_reader(self, agent: str) -> LabelReader:
        return read_opv2v_labels

    def _read_points(self, path: Path) -> Float32Array:
        return read_pcd(path, left_handed=True)


class V2XSet(OPV2V):
    """V2XSet: OPV2V's folder structure with roadside units, whose agent ids are negative (`is_infrastructure`)."""

    splits: ClassVar[tuple[str, ...]] = ("train", "validate", "test")


def read_opv2v_labels(path: Path) -> tuple[FloatArray, Boxes]:
    """Read pose and objects from a yaml file of OPV2V or V2XSet.

    Args:
        path: the file.

    Returns:
        world_SE3_lidar (4, 4), and the objects in the LiDAR frame with ids and labels.

    Raises:
        FileNotFoundError: the file does not exist.
        ValueError: it is malformed; the message names the file, the object and the field.
    """
    lidar_pose, table = read_objects(path)
    world_SE3_lidar = SE3_from_lidar_pose(lidar_pose, f"{path}: lidar_pose")
    lidar_SE3_object = inverse_SE3(world_SE3_lidar) @ SE3_from_carla(table.pose)
    try:
        boxes = Boxes(
            center=lidar_SE3_object[:, :3, 3],
            size=table.size,
            yaw=upright_yaw(lidar_SE3_object),
            track_id=table.ids,
            label=table.kinds,
        )
    except ValueError as error:
        raise ValueError(f"{path}: vehicles: {error}") from None
    return world_SE3_lidar, boxes
