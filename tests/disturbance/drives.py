"""A drive of three agents that see little: what disturbances are tried on."""

from __future__ import annotations

import numpy as np
import pytest

from cobevglue.boxes import Boxes
from cobevglue.disturbance import ObservedFrame
from cobevglue.typing import FloatArray

torch = pytest.importorskip("torch")

from cobevglue.perception import PerceptionOutput  # noqa: E402

KEY = (7, 3)


def pose(x: float, y: float, yaw: float = 0.0) -> FloatArray:
    """(4, 4) world_SE3_lidar of a sensor 1.9 m above the ground, a little tilted."""
    c, s, tilt = np.cos(yaw), np.sin(yaw), 0.02
    matrix = np.eye(4)
    matrix[:3, :3] = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]) @ np.array(
        [[np.cos(tilt), 0, np.sin(tilt)], [0, 1, 0], [-np.sin(tilt), 0, np.cos(tilt)]]
    )
    matrix[:3, 3] = x, y, 1.9
    return matrix


def view(tag: float) -> PerceptionOutput:
    """Two boxes, told apart by where they are."""
    boxes = Boxes(
        [[tag, 1.0, -0.5], [tag, 9.0, -0.7]], [[4.0, 2.0, 1.5]] * 2, [0.0, 1.0], [0.8, 0.4], [0, 1], ["car", "van"]
    )
    features = (torch.zeros(1, 2, 2), torch.zeros(1, 1, 1), torch.zeros(1, 1, 1))
    points = np.zeros((0, 4), np.float32)
    return PerceptionOutput(points, features, boxes, np.full((2, 3), 0.1), boxes.replace(track_id=None), {})


def drive(length: int = 20, second_leaves: int = 10_000) -> list[ObservedFrame]:
    """`ego` stands, `car2` drives 1 m a frame until frame `second_leaves`, `car3` drives away to the left."""
    frames = []
    for i in range(length):
        poses = {"ego": pose(0.0, 0.0), "car2": pose(float(i), 5.0, 0.3), "car3": pose(30.0, 2.0 * i, -1.0)}
        if i >= second_leaves:
            del poses["car2"]
        seen = {agent: view(100.0 * number + i) for number, agent in enumerate(poses)}
        frames.append(ObservedFrame(0.1 * i, seen, poses, poses))
    return frames
