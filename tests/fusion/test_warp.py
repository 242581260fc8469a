"""Maps move as points do: against moving the points themselves."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from cobevglue.fusion.warp import coverage, warp
from cobevglue.perception import CONFIGS, PointPillarsConfig
from cobevglue.se2 import SE2

COMPACT = CONFIGS["compact"]  # 140.8 m x 80 m: as far from square as anybody uses
OFF_CENTRE = PointPillarsConfig(x_range=(0.0, 102.4), y_range=(-12.8, 38.4))


def cell_centres(config: PointPillarsConfig, stride: int) -> tuple[np.ndarray, np.ndarray]:
    """x of the columns and y of the rows [m]."""
    cell = stride * config.pillar
    columns, rows = config.columns // stride, config.rows // stride
    return config.x_range[0] + (np.arange(columns) + 0.5) * cell, config.y_range[0] + (np.arange(rows) + 0.5) * cell


def blob_at(xy: np.ndarray, config: PointPillarsConfig, stride: int, width: float = 2.0) -> torch.Tensor:
    """(1, 1, H, W) a round hill [m]."""
    x, y = cell_centres(config, stride)
    hill = np.exp(-((x[None, :] - xy[0]) ** 2 + (y[:, None] - xy[1]) ** 2) / (2 * width**2))
    return torch.from_numpy(hill)[None, None]


def centre_of(image: torch.Tensor, config: PointPillarsConfig, stride: int) -> np.ndarray:
    """Where the weight of an image lies [m]."""
    x, y = cell_centres(config, stride)
    weight = image[0, 0].numpy()
    centre: np.ndarray = np.array([(weight * x[None, :]).sum(), (weight * y[:, None]).sum()]) / weight.sum()
    return centre


@pytest.mark.parametrize("config", [COMPACT, OFF_CENTRE], ids=["around the agent", "off centre"])
@pytest.mark.parametrize("stride", [2, 4, 8])
@pytest.mark.parametrize(
    "pose",
    [
        SE2(),
        SE2(12.0, 0.0, 0.0),
        SE2(0.0, -7.0, 0.0),
        SE2(0.0, 0.0, math.pi / 2),
        SE2(5.0, 9.0, math.pi / 4),
        SE2(-6.0, 3.0, -2.5),
        SE2(3.0, -4.0, math.pi),
    ],
    ids=str,
)
def test_peak_is_warped_to_its_new_place(config: PointPillarsConfig, stride: int, pose: SE2) -> None:
    middle = np.array([sum(config.x_range) / 2, sum(config.y_range) / 2])
    pose = SE2(*middle) @ pose @ SE2(*middle).inverse()  # turn about the middle, lest the hill leaves the map
    ego_place = middle + [9.0, 5.0]
    other_place = pose.inverse().apply(ego_place)
    moved = warp(blob_at(other_place, config, stride, 2.5), [pose], config)
    np.testing.assert_allclose(centre_of(moved, config, stride), ego_place, atol=0.06 * stride * config.pillar)


@given(
    x=st.floats(-30, 30), y=st.floats(-15, 15), yaw=st.floats(-math.pi, math.pi),
    place=st.tuples(st.floats(-55, 55), st.floats(-28, 28)),
)  # fmt: skip
def test_cells_have_the_value_at_their_centre(x: float, y: float, yaw: float, place: tuple[float, float]) -> None:
    pose = SE2(x, y, yaw)
    # A plane is what bilinear interpolation reproduces without error.
    xs, ys = cell_centres(COMPACT, 4)
    plane = torch.from_numpy(0.3 * xs[None, :] - 0.7 * ys[:, None])[None, None]
    moved = warp(plane, [pose], COMPACT)[0, 0].numpy()
    column, row = int((place[0] + 70.4) / 1.6), int((place[1] + 40.0) / 1.6)
    there = pose.inverse().apply([xs[column], ys[row]])
    if abs(there[0]) < 69.0 and abs(there[1]) < 38.0:
        assert moved[row, column] == pytest.approx(0.3 * there[0] - 0.7 * there[1], abs=1e-6)


def test_nothing_comes_from_beyond_the_other_map() -> None:
    pose = SE2(100.0, 0.0, 0.0)
    moved = warp(torch.ones(1, 2, 25, 44, dtype=torch.float64), [pose], COMPACT)
    xs, _ = cell_centres(COMPACT, 8)
    assert (moved[..., xs < 29.0] == 0).all()
    assert (moved[..., xs > 33.0] == 1).all()
    assert torch.equal(coverage(torch.rand(1, 3, 25, 44, dtype=torch.float64), [pose], COMPACT), moved[:, :1])


def test_there_and_back_is_where_it_was() -> None:
    pose = SE2(11.0, -6.0, 0.8)
    hill = blob_at(np.array([4.0, 3.0]), COMPACT, 2, 4.0)
    back = warp(warp(hill, [pose], COMPACT), [pose.inverse()], COMPACT)
    assert float((back - hill).abs().max()) < 0.02  # interpolating twice flattens the top by 1.5 %


def test_each_of_several_maps_has_its_own_pose() -> None:
    maps = torch.rand(2, 3, 50, 88, dtype=torch.float64)
    poses = [SE2(3.0, 1.0, 0.4), SE2(-9.0, 2.0, 2.0)]
    together = warp(maps, poses, COMPACT)
    for i, pose in enumerate(poses):
        assert torch.equal(together[i : i + 1], warp(maps[i : i + 1], [pose], COMPACT))


def test_no_maps_stay_no_maps() -> None:
    assert warp(torch.zeros(0, 3, 50, 88), [], COMPACT).shape == (0, 3, 50, 88)
