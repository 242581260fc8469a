"""Object graphs: what one agent sees, wherever it stands (paper, section 4.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.se2 import wrap_angle
from cobevglue.typing import FloatArray, IntArray

__all__ = ["ObjectGraph"]


@dataclass(frozen=True, eq=False, slots=True)
class ObjectGraph:
    """A fully connected graph of M tracked boxes.

    Attributes:
        position: (M, 2) centres in the agent's frame [m]; only the pose calculation uses them.
        node: (M, 2) length and width [m].
        track_id: (M,) track ids, or None.
        edge: (M, M, 3) from node m to node n: distance rho [m], bearing theta of n in m's heading frame [rad], heading
            psi of n relative to m's [rad]. The diagonal is zero.
    """

    position: FloatArray
    node: FloatArray
    track_id: IntArray | None
    edge: FloatArray

    @classmethod
    def of(cls, boxes: Boxes) -> ObjectGraph:
        """The object graph of one agent's boxes."""
        position = boxes.center[:, :2]
        step = position[None, :, :] - position[:, None, :]
        rho = np.hypot(step[..., 0], step[..., 1])
        theta = wrap_angle(np.arctan2(step[..., 1], step[..., 0]) - boxes.yaw[:, None])
        psi = wrap_angle(boxes.yaw[None, :] - boxes.yaw[:, None])
        np.fill_diagonal(theta, 0.0)
        return cls(position, boxes.size[:, :2], boxes.track_id, np.stack([rho, theta, psi], axis=-1))

    def __len__(self) -> int:
        return len(self.position)
