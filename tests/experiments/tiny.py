"""A tiny detector and short sequences in OPV2V's format, for fast tests."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch")

from cobevglue.boxes import Boxes  # noqa: E402
from cobevglue.datasets import write_opv2v_frame  # noqa: E402
from cobevglue.datasets.poses import inverse_SE3, transform_boxes  # noqa: E402
from cobevglue.experiments.study import StudySettings  # noqa: E402
from cobevglue.perception import PointPillars, PointPillarsConfig  # noqa: E402
from cobevglue.perception.config import DetectionConfig  # noqa: E402
from cobevglue.typing import Float32Array, FloatArray  # noqa: E402

TINY = PointPillarsConfig(
    x_range=(-12.8, 12.8),
    y_range=(-12.8, 12.8),
    pillar=0.8,
    pillar_channels=16,
    block_layers=(1, 1, 1),
    block_channels=(8, 8, 16),
    up_channels=8,
    shrink_channels=8,
    detection=DetectionConfig(score_threshold=0.0, max_detections=12),
)
CARS = Boxes(
    center=[[4.0, 3.0, -1.1], [-5.0, 4.0, -1.1], [6.0, -5.0, -1.1], [-3.0, -6.0, -1.1], [0.0, 9.0, -1.1]],
    size=[[4.4, 1.9, 1.6], [4.0, 1.8, 1.5], [4.6, 2.0, 1.7], [5.0, 2.0, 1.9], [4.2, 1.8, 1.5]],
    yaw=[0.2, 1.4, -0.7, 3.0, 0.1],
    track_id=[11, 12, 13, 14, 15],
    label=["car", "car", "van", "car", "car"],
)
"""In the world, whose ground is at -1.9 m: a LiDAR at its origin is one on a car."""


def tiny_detector(folder: Path) -> Path:
    """A file with an untrained detector, which returns some boxes."""
    torch.manual_seed(3)
    path = folder / "tiny.safetensors"
    detector = PointPillars(TINY)
    detector.save(path)
    return path


def world_SE3_lidar(agent: int, frame: int) -> FloatArray:
    """Agents drive slowly, side by side, with different headings."""
    yaw = 0.3 * agent
    matrix = np.eye(4)
    matrix[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    matrix[:2, 3] = 0.1 * frame + 1.5 * agent, -1.0 * agent
    return matrix


def cloud(cars: Boxes, lidar_SE3_world: FloatArray, seed: int) -> Float32Array:
    """(N, 4) some points on the ground and 60 in every car, in the LiDAR's frame."""
    rng = np.random.default_rng(seed)
    ground = np.column_stack([rng.uniform(-12, 12, (300, 2)), np.full(300, -1.9)])
    local = rng.uniform(-0.49, 0.49, (len(cars), 60, 3)) * cars.size[:, None]
    c, s = np.cos(cars.yaw)[:, None], np.sin(cars.yaw)[:, None]
    turned = np.stack([c * local[..., 0] - s * local[..., 1], s * local[..., 0] + c * local[..., 1], local[..., 2]], -1)
    xyz = np.concatenate([ground, (turned + cars.center[:, None]).reshape(-1, 3)])
    moved = xyz @ lidar_SE3_world[:3, :3].T + lidar_SE3_world[:3, 3]
    return np.column_stack([moved, np.full(len(xyz), 0.5)]).astype(np.float32)


def write_agent(
    folder: Path, agent: int, frames: range, cars: Boxes = CARS, with_clouds: bool = True, name: str | None = None
) -> None:
    """An agent of a scenario; it has files in these frames only."""
    for frame in frames:
        pose = world_SE3_lidar(agent, frame)
        points = cloud(cars, inverse_SE3(pose), 100 * agent + frame) if with_clouds else None
        objects = transform_boxes(cars, inverse_SE3(pose))
        write_opv2v_frame(folder / (name or f"{agent}"), f"{2 * frame:06d}", pose, objects, points)


def tiny_tree(root: Path, frames: int = 3) -> Path:
    """A data set with the split "test": a sequence of two agents, and one of three, one of which arrives late."""
    for agent in (1, 2):
        write_agent(root / "test" / "a_pair", agent, range(frames))
    for agent in (1, 2):
        write_agent(root / "test" / "b_three", agent, range(frames))
    write_agent(root / "test" / "b_three", 3, range(1, frames))
    return root


def tiny_settings(folder: Path, **more: object) -> StudySettings:
    """A study of `tiny_tree` in `folder/data`, with the detector in `folder`."""
    values = {
        "dataset": "opv2v",
        "root": str(folder / "data"),
        "detector": str(folder / "tiny.safetensors"),
        "untrained": True,
    }
    return StudySettings(**{**values, **more})  # type: ignore[arg-type]
