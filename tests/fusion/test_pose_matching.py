"""Maps that are out of place are brought back, before anything is learnt."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch
from torch import Tensor

from cobevglue.fusion.pose_matching import PoseMatching, _motion
from cobevglue.fusion.v2vnet_robust import apply_correction
from cobevglue.fusion.warp import coverage, warp
from cobevglue.perception import PointPillarsConfig
from cobevglue.se2 import SE2

CONFIG = PointPillarsConfig(x_range=(-51.2, 51.2), y_range=(-38.4, 38.4))
ROWS, COLUMNS, CELL = CONFIG.rows // 4, CONFIG.columns // 4, 4 * CONFIG.pillar
CHANNELS = 12


def hills(seed: int = 0, count: int = 60) -> Tensor:
    """(1, C, H, W) objects of a few metres, each of another mixture of channels."""
    rng = np.random.default_rng(seed)
    x = CONFIG.x_range[0] + (np.arange(COLUMNS) + 0.5) * CELL
    y = CONFIG.y_range[0] + (np.arange(ROWS) + 0.5) * CELL
    at = rng.uniform((-50.0, -37.0), (50.0, 37.0), (count, 2))
    squares = (x[None, None, :] - at[:, 0, None, None]) ** 2 + (y[None, :, None] - at[:, 1, None, None]) ** 2
    image = np.einsum("kc,khw->chw", rng.random((count, CHANNELS)), np.exp(-squares / (2.0 * 1.8**2)))
    return torch.from_numpy(image.astype(np.float32))[None]


def make_matching(seed: int = 0) -> PoseMatching:
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return PoseMatching(CONFIG, CHANNELS)


def matched(matching: PoseMatching, first: Tensor, second: Tensor, pose: SE2) -> tuple[list[float], float]:
    """The motion and the logit for one pair, whose second map is moved by `pose`."""
    moved = warp(second, [pose], CONFIG)
    middle = torch.tensor([[pose.x / 2.0, pose.y / 2.0]])
    with torch.no_grad():
        motions, logits = matching(first, moved, coverage(second, [pose], CONFIG), middle)
    return motions[0].tolist(), logits[0].item()


@pytest.mark.parametrize(
    ("claimed", "what"),
    [
        (SE2(), "nothing"),
        (SE2(1.6, 0.0, 0.0), "a cell along x"),
        (SE2(0.0, -3.2, 0.0), "two cells along y"),
        (SE2(1.0, 0.7, 0.0), "parts of cells"),
        (SE2(0.0, 0.0, math.radians(4.0)), "a turn to the left"),
        (SE2(0.0, 0.0, math.radians(-4.0)), "a turn to the right"),
        (SE2(-1.5, 1.0, math.radians(3.0)), "all together"),
    ],
)
def test_slightly_misplaced_map_is_corrected(claimed: SE2, what: str) -> None:
    """Two views of the same map are truly in the same place, wherever one is claimed to be."""
    matching, view, pose = make_matching(), hills(), claimed
    for _ in range(4):
        motion, _ = matched(matching, view, view, pose)
        pose = apply_correction(pose, motion)
    position, heading = pose.error_to(SE2())
    assert position < 0.25, what
    assert heading < math.radians(0.5), what


def test_empty_maps_are_not_moved() -> None:
    motion, _ = matched(make_matching(), torch.zeros_like(hills()), torch.zeros_like(hills()), SE2(2.0, 1.0, 0.1))
    assert motion == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)


def test_uncovered_map_is_not_moved() -> None:
    far = SE2(400.0, 0.0, 0.2)
    motion, logit = matched(make_matching(), hills(), hills(), far)
    assert motion == pytest.approx([0.0, 0.0, 0.0], abs=1e-6)
    assert math.isfinite(logit)


def test_motion_is_that_of_weighted_points() -> None:
    at = torch.from_numpy(np.random.default_rng(0).uniform(-40.0, 40.0, (1, 2, 5, 6)).astype(np.float32))
    x, y, yaw = 0.5, -0.2, 0.03
    moves = torch.stack([x - yaw * at[:, 1], y + yaw * at[:, 0]], dim=1)
    weight = torch.full((1, 1, 5, 6), 1e3)
    moves[..., 0], weight[..., 0] = 1e3, 0.0  # nonsense that does not count
    (motion,), fitted = _motion(moves, at, weight)
    np.testing.assert_allclose(motion, [x, y, yaw], rtol=1e-2)
    np.testing.assert_allclose(fitted[..., 1:], moves[..., 1:], atol=0.02)


def test_rotation_centre_does_not_change_moved_points() -> None:
    matching, view, claimed = make_matching(), hills(), SE2(0.8, -0.6, math.radians(2.0))
    moved, covered = warp(view, [claimed], CONFIG), coverage(view, [claimed], CONFIG)
    centre, aside = torch.zeros(1, 2), torch.tensor([[20.0, -10.0]])
    with torch.no_grad():
        (a,), (b,) = (matching(view, moved, covered, middle)[0].tolist() for middle in (centre, aside))
    assert a[2] == pytest.approx(b[2], rel=0.2)
    assert b[0] == pytest.approx(a[0] + 10.0 * a[2], abs=0.1)
    assert b[1] == pytest.approx(a[1] + 20.0 * a[2], abs=0.1)


def test_gradients_reach_every_weight() -> None:
    matching = make_matching()
    view, pose = hills(), SE2(1.0, 0.5, 0.05)
    motions, logits = matching(view, warp(view, [pose], CONFIG), coverage(view, [pose], CONFIG), torch.zeros(1, 2))
    (motions.square().sum() + logits.sum()).backward()
    assert [name for name, p in matching.named_parameters() if p.grad is None or not p.grad.any()] == []
