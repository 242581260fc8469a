"""OpenCOOD, CoAlign and HEAL: poses, boxes and the transforms of a batch.

Their conventions:

- `lidar_pose` is [x, y, z, roll, yaw, pitch] in metres and degrees, in CARLA's left-handed axes (y to the right):
  `SE3_from_lidar_pose` reads it, `lidar_pose_from_SE3` writes it.
- A box is an (N, 7) row x, y, z, h, w, l, yaw (`order="hwl"`, their default) or x, y, z, l, w, h, yaw (`"lwh"`), or the
  (N, 8, 3) corners of it: four below, then four above, each time (front, -y), (front, +y), (rear, +y), (rear, -y).
- `pairwise_t_matrix[b, i, j]` maps coordinates of agent i to those of agent j; agent 0 is the ego.

Data of OPV2V and V2XSet are left-handed in these projects, also the point clouds and boxes (`left_handed=True`, the
default here). Those of DAIR-V2X and V2V4Real are right-handed: pass `left_handed=False`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.datasets.poses import SE3_from_lidar_pose, SE3_from_SE2, carla_from_SE3, inverse_SE3, mirrored, rigid_SE3
from cobevglue.se2 import SE2
from cobevglue.typing import ArrayLike, FloatArray

__all__ = [
    "SE3_from_lidar_pose",
    "boxes_from_centers",
    "boxes_from_corners",
    "centers_from_boxes",
    "corners_from_boxes",
    "lidar_pose_from_SE3",
    "normalized_affine",
    "pairwise_t_matrix",
]

_ORDERS = {"hwl": (5, 4, 3), "lwh": (3, 4, 5)}
"""Columns of length, width and height."""
_CORNERS = 0.5 * np.array(
    [[1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, -1], [1, -1, 1], [1, 1, 1], [-1, 1, 1], [-1, -1, 1]]
)
"""Corners of a unit box in their order."""
_FRONT, _REAR, _PLUS_Y, _MINUS_Y = [0, 1, 4, 5], [2, 3, 6, 7], [1, 2, 5, 6], [0, 3, 4, 7]


def lidar_pose_from_SE3(world_SE3_lidar: ArrayLike, *, left_handed: bool = True) -> list[float]:
    """Convert a right-handed pose to a `lidar_pose`, the inverse of `SE3_from_lidar_pose`.

    Args:
        world_SE3_lidar: (4, 4) proper rigid transform.
        left_handed: see `SE3_from_lidar_pose`.

    Returns:
        x, y, z [m], roll, yaw, pitch [degrees].

    Raises:
        ValueError: the matrix is not a proper rigid transform.
    """
    matrix = rigid_SE3(world_SE3_lidar, "world_SE3_lidar")
    pose: list[float] = carla_from_SE3(matrix if left_handed else mirrored(matrix)).tolist()
    return pose


def boxes_from_centers(
    array: ArrayLike, *, order: str = "hwl", left_handed: bool = True, score: ArrayLike | None = None
) -> Boxes:
    """Convert (N, 7) boxes to `Boxes`.

    Args:
        array: (N, 7) x, y, z of the centre [m], the three sizes [m] in `order`, yaw [rad].
        order: "hwl" or "lwh".
        left_handed: the y axis of the array points to the right; it is mirrored.
        score: (N,) confidences, or None.

    Raises:
        ValueError: another shape or order, or invalid boxes; the message names field and row.
    """
    columns = _columns(order)
    rows = _array("array", array, (7,))
    side = -1.0 if left_handed else 1.0
    return Boxes(rows[:, :3] * [1.0, side, 1.0], rows[:, columns], side * rows[:, 6], score=score)


def centers_from_boxes(boxes: Boxes, *, order: str = "hwl", left_handed: bool = True) -> FloatArray:
    """Convert boxes to (N, 7) rows, the inverse of `boxes_from_centers`.

    Raises:
        ValueError: another order.
    """
    rows = np.empty((len(boxes), 7))
    side = -1.0 if left_handed else 1.0
    rows[:, :3] = boxes.center * [1.0, side, 1.0]
    rows[:, _columns(order)] = boxes.size
    rows[:, 6] = side * boxes.yaw
    return rows


def boxes_from_corners(corners: ArrayLike, *, left_handed: bool = True, score: ArrayLike | None = None) -> Boxes:
    """Convert eight corners a box to `Boxes`.

    Of tilted boxes, centre and sizes are kept, roll and pitch are dropped.

    Args:
        corners: (N, 8, 3) corners [m] in the order of the module docstring.
        left_handed: the y axis of the corners points to the right; it is mirrored.
        score: (N,) confidences, or None.

    Raises:
        ValueError: another shape, or invalid boxes; the message names field and row.
    """
    points = _array("corners", corners, (8, 3))
    lengthwise = points[:, _FRONT].mean(axis=1) - points[:, _REAR].mean(axis=1)
    crosswise = points[:, _PLUS_Y].mean(axis=1) - points[:, _MINUS_Y].mean(axis=1)
    upwards = points[:, 4:].mean(axis=1) - points[:, :4].mean(axis=1)
    size = np.stack([np.linalg.norm(edge, axis=-1) for edge in (lengthwise, crosswise, upwards)], axis=-1)
    yaw = np.arctan2(lengthwise[:, 1], lengthwise[:, 0])
    side = -1.0 if left_handed else 1.0
    return Boxes(points.mean(axis=1) * [1.0, side, 1.0], size, side * yaw, score=score)


def corners_from_boxes(boxes: Boxes, *, left_handed: bool = True) -> FloatArray:
    """(N, 8, 3) corners [m] in the order of the module docstring, the inverse of `boxes_from_corners`."""
    side = -1.0 if left_handed else 1.0
    c, s = np.cos(boxes.yaw)[:, None], side * np.sin(boxes.yaw)[:, None]
    offset = _CORNERS * boxes.size[:, None]
    turned = np.stack(
        [c * offset[..., 0] - s * offset[..., 1], s * offset[..., 0] + c * offset[..., 1], offset[..., 2]], axis=-1
    )
    corners: FloatArray = turned + (boxes.center * [1.0, side, 1.0])[:, None]
    return corners


def pairwise_t_matrix(
    ego_SE2_agents: Sequence[Sequence[SE2 | ArrayLike]], max_agents: int, *, left_handed: bool = True
) -> FloatArray:
    """Compute a batch's `pairwise_t_matrix` from poses of the agents in the ego frame.

    An agent without a pose (a refused alignment) has to be left out of its sample, with its features: there is no
    transform that would mean "absent".

    Args:
        ego_SE2_agents: per sample, the poses of its agents in the frame of its agent 0, in the order of the agents in
            the batch: `SE2` (heights of the LiDARs taken as equal), or (4, 4) right-handed transforms.
        max_agents: L, at least the number of agents of any sample.
        left_handed: the point clouds and features of the batch are left-handed.

    Returns:
        (B, L, L, 4, 4): entry [b, i, j] maps coordinates of agent i to those of agent j; the identity for i = j and
        where there is no agent.

    Raises:
        ValueError: too many agents in a sample, an agent without a pose, or a matrix that is not rigid; the message
            names sample and agent.
    """
    result = np.tile(np.eye(4), (len(ego_SE2_agents), max_agents, max_agents, 1, 1))
    for sample, poses in enumerate(ego_SE2_agents):
        if len(poses) > max_agents:
            raise ValueError(f"sample {sample} has {len(poses)} agents, max_agents is {max_agents}")
        if not poses:
            continue
        matrices = np.stack([_matrix(pose, f"sample {sample}, agent {agent}") for agent, pose in enumerate(poses)])
        if left_handed:
            matrices = mirrored(matrices)
        pairs = inverse_SE3(matrices)[None, :] @ matrices[:, None]
        pairs[np.arange(len(poses)), np.arange(len(poses))] = np.eye(4)  # exactly, without the rounding of a product
        result[sample, : len(poses), : len(poses)] = pairs
    return result


def normalized_affine(pairwise: ArrayLike, height: int, width: int, cell: float) -> FloatArray:
    """Convert a `pairwise_t_matrix` to the normalised affine matrices of CoAlign and HEAL.

    These are what `torch.nn.functional.affine_grid` takes, in coordinates of -1 to 1 over a feature map whose centre is
    the agent's origin. To see the map of agent j in the frame of the ego, pass entry [b, 0, j] to it.

    Args:
        pairwise: (..., 4, 4) planar part of transforms in metres.
        height: rows of the feature map, along y.
        width: columns, along x.
        cell: size of a cell of the feature map [m]: their `discrete_ratio * downsample_rate`.

    Returns:
        (..., 2, 3)

    Raises:
        ValueError: a shape other than (..., 4, 4), or a size that is not positive.
    """
    transforms = np.asarray(pairwise, dtype=np.float64)
    if transforms.shape[-2:] != (4, 4):
        raise ValueError(f"pairwise must have shape (..., 4, 4), got {transforms.shape}")
    if min(height, width, cell) <= 0:
        raise ValueError(f"height, width and cell must be > 0, got {height}, {width}, {cell}")
    half = np.array([width, height]) * cell / 2.0
    affine = np.empty((*transforms.shape[:-2], 2, 3))
    affine[..., :2] = transforms[..., :2, :2] * half[None, :] / half[:, None]
    affine[..., 2] = transforms[..., :2, 3] / half
    return affine


def _matrix(pose: SE2 | ArrayLike | None, where: str) -> FloatArray:
    if pose is None:
        raise ValueError(f"{where} has no pose: leave the agent out of the sample")
    return SE3_from_SE2(pose) if isinstance(pose, SE2) else rigid_SE3(pose, where)


def _columns(order: str) -> list[int]:
    if order not in _ORDERS:
        raise ValueError(f"order must be one of {', '.join(_ORDERS)}, got {order!r}")
    return list(_ORDERS[order])


def _array(name: str, values: ArrayLike, shape: tuple[int, ...]) -> FloatArray:
    """(N, *shape) numbers; an empty list is N = 0."""
    array = np.asarray(values, dtype=np.float64)
    if array.size == 0:
        return array.reshape(0, *shape)
    if array.shape[1:] != shape:
        raise ValueError(f"{name} must have shape (N, {', '.join(map(str, shape))}), got {array.shape}")
    return array
