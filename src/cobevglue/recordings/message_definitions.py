"""Definitions of the messages that `replay` reads and that bags of ROS 2 Humble and older do not contain.

The names and types of the fields, as their packages have them; std_msgs, geometry_msgs and sensor_msgs come with the
library that reads bags.
"""

from __future__ import annotations

__all__ = ["DETECTIONS", "LAYOUTS"]

_HEADER = "std_msgs/Header header\n"

_VISION_COMMON = {
    "vision_msgs/msg/Detection3DArray": _HEADER + "vision_msgs/Detection3D[] detections",
    "vision_msgs/msg/BoundingBox3D": "geometry_msgs/Pose center\ngeometry_msgs/Vector3 size",
}
DETECTIONS = _VISION_COMMON | {
    "vision_msgs/msg/Detection3D": _HEADER
    + "vision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox3D bbox\nstring id",
    "vision_msgs/msg/ObjectHypothesisWithPose": "vision_msgs/ObjectHypothesis hypothesis\n"
    "geometry_msgs/PoseWithCovariance pose",
    "vision_msgs/msg/ObjectHypothesis": "string class_id\nfloat64 score",
}
"""vision_msgs 4, since ROS 2 Humble."""

_DETECTIONS_BEFORE_HUMBLE = _VISION_COMMON | {
    "vision_msgs/msg/Detection3D": _HEADER
    + "vision_msgs/ObjectHypothesisWithPose[] results\nvision_msgs/BoundingBox3D bbox\n"
    "sensor_msgs/PointCloud2 source_cloud\nbool is_tracking\nstring tracking_id",
    "vision_msgs/msg/ObjectHypothesisWithPose": "string id\nfloat64 score\ngeometry_msgs/PoseWithCovariance pose",
}
# vision_msgs 2, of ROS 2 Foxy


def _autoware(package: str) -> dict[str, str]:
    poses = "geometry_msgs/PoseWithCovariance pose_with_covariance\n"
    twist = "geometry_msgs/TwistWithCovariance twist_with_covariance\n"
    common = f"{package}/ObjectClassification[] classification\n"
    return {
        f"{package}/msg/DetectedObjects": f"{_HEADER}{package}/DetectedObject[] objects",
        f"{package}/msg/DetectedObject": f"float32 existence_probability\n{common}"
        f"{package}/DetectedObjectKinematics kinematics\n{package}/Shape shape",
        f"{package}/msg/DetectedObjectKinematics": poses
        + "bool has_position_covariance\nuint8 orientation_availability\n"
        + twist
        + "bool has_twist\nbool has_twist_covariance",
        f"{package}/msg/TrackedObjects": f"{_HEADER}{package}/TrackedObject[] objects",
        f"{package}/msg/TrackedObject": "unique_identifier_msgs/UUID object_id\nfloat32 existence_probability\n"
        f"{common}{package}/TrackedObjectKinematics kinematics\n{package}/Shape shape",
        f"{package}/msg/TrackedObjectKinematics": poses
        + twist
        + "geometry_msgs/AccelWithCovariance acceleration_with_covariance\n"
        + "uint8 orientation_availability\nbool is_stationary",
        f"{package}/msg/ObjectClassification": "uint8 label\nfloat32 probability",
        f"{package}/msg/Shape": "uint8 type\ngeometry_msgs/Polygon footprint\ngeometry_msgs/Vector3 dimensions",
    }


_ONE_LAYOUT = (
    _autoware("autoware_perception_msgs")
    | _autoware("autoware_auto_perception_msgs")
    | {"udp_msgs/msg/UdpPacket": _HEADER + "string address\nuint16 src_port\nuint8[] data"}
)
LAYOUTS = (DETECTIONS | _ONE_LAYOUT, _DETECTIONS_BEFORE_HUMBLE)
"""All definitions by type; a type may have a second layout."""
