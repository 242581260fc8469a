"""Writer of frames in V2V4Real's format."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from cobevglue.boxes import Boxes
from cobevglue.datasets.atomic_files import atomic_write
from cobevglue.datasets.pcd import write_pcd_rgb
from cobevglue.datasets.poses import mirrored, rigid_SE3
from cobevglue.datasets.v2v4real import LEFT_HANDED
from cobevglue.datasets.yaml_tree import check_timestamp
from cobevglue.typing import ArrayLike

__all__ = ["write_v2v4real_frame"]

try:
    from yaml import CDumper as _Dumper
except ImportError:  # PyYAML built without libyaml
    from yaml import Dumper as _Dumper  # type: ignore[assignment]

AGENTS = ("0", "1")
"""Names of the two cars."""


def write_v2v4real_frame(
    agent_folder: str | Path,
    timestamp: str,
    world_SE3_lidar: ArrayLike,
    objects: Boxes,
    points: ArrayLike | None = None,
    *,
    speeds: Mapping[int, float] | None = None,
    left_handed: bool = LEFT_HANDED,
) -> None:
    """Write one frame of one car: `<timestamp>.pcd` if there is a cloud, then `<timestamp>.yaml`.

    The inverse of `V2V4Real`, which reads pose and objects to floating-point precision, points exactly and intensities
    to 8 bits. All objects are associated: `ass_id` is the `track_id`. The pose is dumped as a numpy array, as other
    tools of this data set require. Files are written atomically.

    Args:
        agent_folder: `<root>/<split>/<scenario>/<agent>`, the agent "0" or "1"; created if missing.
        timestamp: file number, digits only; frames 0.1 s apart are numbered 1 apart.
        world_SE3_lidar: (4, 4) right-handed pose of the LiDAR.
        objects: the objects visible to the car, in its LiDAR frame, with `track_id` >= 0. Labels are stored as
            `obj_type`, capitalised; "Car" without labels. They are read in lower case.
        points: (N, 4) x, y, z [m], intensity [0, 1] in the LiDAR frame; None to store no cloud.
        speeds: of objects by id [km/h]; 0 by default.
        left_handed: write files with y to the right, to be read with the same option.

    Raises:
        ValueError: the pose is not rigid, the agent is not "0" or "1", the timestamp is not a number, objects have no
            ids or negative ones, or points are malformed.
    """
    folder = Path(agent_folder)
    if folder.name not in AGENTS:
        raise ValueError(f"agents of V2V4Real are named 0 and 1, got {folder.name!r}")
    check_timestamp(timestamp)
    if objects.track_id is None or (objects.track_id < 0).any():
        raise ValueError("objects must have a track_id, >= 0")
    pose = rigid_SE3(world_SE3_lidar, "world_SE3_lidar")
    center, yaw = objects.center, np.rad2deg(objects.yaw)
    if left_handed:
        pose, center, yaw = mirrored(pose), center * [1.0, -1.0, 1.0], -yaw
    vehicles: dict[int, dict[str, Any]] = {}
    for row, track_id in enumerate(objects.track_id.tolist()):
        vehicles[track_id] = {
            "angle": [0.0, float(yaw[row]), 0.0],
            "ass_id": track_id,
            "center": [0.0, 0.0, 0.0],
            "extent": (objects.size[row] / 2).tolist(),
            "location": center[row].tolist(),
            "obj_type": "Car" if objects.label is None else str(objects.label[row]).capitalize(),
            "speed": float((speeds or {}).get(track_id, 0.0)),
        }
    document = {"lidar_pose": pose, "true_ego_pos": pose.copy(), "vehicles": vehicles}
    # Users of this data set have numpy 1; its name of the helper is valid in numpy 2, too.
    text = yaml.dump(document, Dumper=_Dumper).replace("numpy._core.", "numpy.core.")
    if points is not None:
        write_pcd_rgb(folder / f"{timestamp}.pcd", points, left_handed=left_handed)
    with atomic_write(folder / f"{timestamp}.yaml") as path:
        path.write_text(text, encoding="utf-8")
