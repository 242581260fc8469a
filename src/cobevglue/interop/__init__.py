"""Object lists and poses of other projects to `Boxes` and `SE2`, and back.

- `opencood`: OpenCOOD, CoAlign and HEAL: `lidar_pose`, corners, (N, 7) arrays, and a batch's `pairwise_t_matrix`.
- `nuscenes`: annotations and results of nuScenes.
- `kitti`: label files and calibrations of KITTI.
- `ros`: messages of ROS with objects or points (to `Boxes` only).

A round trip is exact to floating-point precision where the other format holds what `Boxes` hold: upright boxes in a
level frame. Only NumPy and SciPy are needed; no code of these projects is imported.
"""

from cobevglue.interop.kitti import (
    boxes_from_kitti,
    kitti_from_boxes,
    read_kitti_calibration,
    read_kitti_objects,
    write_kitti_objects,
)
from cobevglue.interop.nuscenes import SE3_from_nuscenes, boxes_from_nuscenes, nuscenes_from_boxes
from cobevglue.interop.opencood import (
    SE3_from_lidar_pose,
    boxes_from_centers,
    boxes_from_corners,
    centers_from_boxes,
    corners_from_boxes,
    lidar_pose_from_SE3,
    normalized_affine,
    pairwise_t_matrix,
)
from cobevglue.interop.ros import RosObjects, boxes_from_ros, points_from_ros, stamp_from_ros

__all__ = [
    "RosObjects",
    "SE3_from_lidar_pose",
    "SE3_from_nuscenes",
    "boxes_from_centers",
    "boxes_from_corners",
    "boxes_from_kitti",
    "boxes_from_nuscenes",
    "boxes_from_ros",
    "centers_from_boxes",
    "corners_from_boxes",
    "kitti_from_boxes",
    "lidar_pose_from_SE3",
    "normalized_affine",
    "nuscenes_from_boxes",
    "pairwise_t_matrix",
    "points_from_ros",
    "read_kitti_calibration",
    "read_kitti_objects",
    "stamp_from_ros",
    "write_kitti_objects",
]
