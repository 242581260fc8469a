"""Equation (1c) of CoBEVGlue: agents' bird's-eye-view maps, seen in the ego's frame."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from cobevglue.perception.config import PointPillarsConfig
from cobevglue.se2 import SE2

__all__ = ["coverage", "warp"]


def warp(maps: Tensor, ego_SE2_agents: Sequence[SE2], config: PointPillarsConfig) -> Tensor:
    """Maps of agents, moved to where the ego has them.

    A cell of the result is what lies, in the agent's map, where the centre of the ego's cell is: bilinear between the
    four nearest cells, 0 outside. The identity leaves a map as it is, to the last bit.

    Args:
        maps: (B, C, H, W) of B agents, each in its own frame, covering the detector's range at any stride; rows are y,
            columns are x, both from min to max.
        ego_SE2_agents: B poses of the agents in the ego's frame.
        config: the detector's settings, for the range.

    Returns:
        (B, C, H, W) in the ego's frame.
    """
    moving = [row for row, pose in enumerate(ego_SE2_agents) if pose != SE2()]
    if not moving:
        return maps
    theta = torch.from_numpy(np.stack([_normalised(ego_SE2_agents[row], config) for row in moving]))
    grid = F.affine_grid(theta.to(maps.device, maps.dtype), [len(moving), *maps.shape[1:]], align_corners=False)
    moved = F.grid_sample(maps[moving], grid, mode="bilinear", padding_mode="zeros", align_corners=False)
    return maps.index_copy(0, torch.tensor(moving, device=maps.device), moved.to(maps.dtype))


def coverage(maps: Tensor, ego_SE2_agents: Sequence[SE2], config: PointPillarsConfig) -> Tensor:
    """(B, 1, H, W) how much of each of the ego's cells the agents' maps cover, 0 to 1."""
    return warp(torch.ones_like(maps[:, :1]), ego_SE2_agents, config)


def _normalised(ego_SE2_agent: SE2, config: PointPillarsConfig) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """(2, 3) from the ego's to the agent's coordinates, both scaled to -1..1 over the range: what `affine_grid` takes.

    As the range is longer than it is wide, a turn in metres is a turn with a shear in these coordinates.
    """
    (x_min, x_max), (y_min, y_max) = config.x_range, config.y_range
    centre = np.array([x_min + x_max, y_min + y_max]) / 2.0
    half = np.array([x_max - x_min, y_max - y_min]) / 2.0
    agent_SE2_ego = ego_SE2_agent.inverse()
    rotation = agent_SE2_ego.rotation
    shift = rotation @ centre + agent_SE2_ego.translation - centre
    return np.column_stack([rotation * half[None, :] / half[:, None], shift / half])
