"""Writer of frames in OPV2V's format."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from cobevglue.boxes import Boxes
from cobevglue.datasets.atomic_files import atomic_write
from cobevglue.datasets.pcd import write_pcd_rgb
from cobevglue.datasets.poses import carla_from_SE3, rigid_SE3
from cobevglue.datasets.yaml_tree import check_timestamp
from cobevglue.typing import ArrayLike

__all__ = ["write_opv2v_frame"]

try:
    from yaml import CSafeDumper as _SafeDumper
except ImportError:  # PyYAML built without libyaml
    from yaml import SafeDumper as _SafeDumper  # type: ignore[assignment]


def write_opv2v_frame(
    agent_folder: str | Path,
    timestamp: str,
    world_SE3_lidar: ArrayLike,
    objects: Boxes,
    points: ArrayLike | None = None,
    *,
    speeds: Mapping[int, float] | None = None,
    ego_speed: float = 0.0,
    world_SE3_vehicle: ArrayLike | None = None,
    point_counts: Mapping[int, int] | None = None,
) -> None:
    """Write one frame of one agent: `<timestamp>.pcd` if there is a cloud, then `<timestamp>.yaml`.

    The inverse of `OPV2V`, which reads pose and objects to floating-point precision, points exactly and intensities to
    8 bits. Axes are mirrored to OPV2V's left-handed ones. Labels are stored as `obj_type`. Files are written
    atomically.

    Args:
        agent_folder: `<root>/<split>/<scenario>/<agent>`; created if missing. Roadside units have negative names.
        timestamp: file number, digits only; frames 0.1 s apart are numbered 2 apart, as in OPV2V.
        world_SE3_lidar: (4, 4) right-handed pose of the LiDAR.
        objects: the objects visible to the agent, in its LiDAR frame, with `track_id`.
        points: (N, 4) x, y, z [m], intensity [0, 1] in the LiDAR frame; None to store no cloud.
        speeds: of objects by id [km/h]; 0 by default.
        ego_speed: of the agent [km/h].
        world_SE3_vehicle: (4, 4) right-handed pose of the vehicle on the ground; by default that of the LiDAR.
        point_counts: number of points of the cloud on each object by id; stored as `points`, an extension of OPV2V.

    Raises:
        ValueError: a pose is not rigid, the timestamp is not a number, objects have no ids, or points are malformed.
    """
    check_timestamp(timestamp)
    if objects.track_id is None:
        raise ValueError("objects must have a track_id")
    lidar = rigid_SE3(world_SE3_lidar, "world_SE3_lidar")
    vehicle = lidar if world_SE3_vehicle is None else rigid_SE3(world_SE3_vehicle, "world_SE3_vehicle")
    poses = carla_from_SE3(lidar @ _lidar_SE3_object(objects))
    offset = np.zeros((len(objects), 3))
    offset[:, 2] = objects.size[:, 2] / 2  # OPV2V's location is on the ground, `center` is the offset of the box centre
    vehicles: dict[int, dict[str, Any]] = {}
    for row, track_id in enumerate(objects.track_id.tolist()):
        vehicles[track_id] = {
            "angle": poses[row, 3:].tolist(),
            "center": offset[row].tolist(),
            "extent": (objects.size[row] / 2).tolist(),
            "location": (poses[row, :3] - offset[row]).tolist(),
            "speed": float((speeds or {}).get(track_id, 0.0)),
        }
        if objects.label is not None:
            vehicles[track_id]["obj_type"] = str(objects.label[row])
        if point_counts is not None and track_id in point_counts:
            vehicles[track_id]["points"] = int(point_counts[track_id])
    document = {
        "ego_speed": float(ego_speed),
        "lidar_pose": carla_from_SE3(lidar).tolist(),
        "predicted_ego_pos": carla_from_SE3(vehicle).tolist(),
        "true_ego_pos": carla_from_SE3(vehicle).tolist(),
        "vehicles": vehicles,
    }
    folder = Path(agent_folder)
    if points is not None:
        write_pcd_rgb(folder / f"{timestamp}.pcd", points)
    with atomic_write(folder / f"{timestamp}.yaml") as path, path.open("w", encoding="utf-8") as file:
        yaml.dump(document, file, Dumper=_SafeDumper)


def _lidar_SE3_object(objects: Boxes) -> ArrayLike:
    """(N, 4, 4) poses of upright boxes."""
    matrix = np.zeros((len(objects), 4, 4))
    c, s = np.cos(objects.yaw), np.sin(objects.yaw)
    matrix[:, 0, 0], matrix[:, 0, 1], matrix[:, 1, 0], matrix[:, 1, 1] = c, -s, s, c
    matrix[:, 2, 2] = matrix[:, 3, 3] = 1.0
    matrix[:, :3, 3] = objects.center
    return matrix
