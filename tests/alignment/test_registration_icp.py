"""ICP: a small error of the claimed pose is repaired, and whatever happens, something sensible comes back."""

from __future__ import annotations

import math
import sys

import numpy as np
import pytest

from cobevglue import SE2
from cobevglue.alignment import Observation, group_aligner
from cobevglue.alignment.registration import ICP2D, ICP3D
from cobevglue.alignment.registration.icp import planar_icp
from cobevglue.typing import Float32Array, FloatArray

from .observations import align, cloud_of, error, pose_of, scene

EGO, OTHER = SE2(2.0, -1.0, 0.3), SE2(8.0, -6.0, 2.0)
TRUTH = EGO.inverse() @ OTHER
BOTH = pytest.mark.parametrize("name", ["icp-2d", "icp-3d"])


def observed(cloud: Float32Array, claimed: SE2) -> Observation:
    return Observation(points=cloud, pose=pose_of(claimed))


def pair(off: SE2, seed: int = 0) -> dict[str, Observation]:
    """Two agents at a street corner; what other claims is `off`."""
    world = scene(seed)
    return {
        "ego": observed(cloud_of(world, EGO, 1), EGO),
        "other": observed(cloud_of(world, OTHER, 2), OTHER @ off),
    }


@BOTH
@pytest.mark.parametrize("budget", [None, 4000])
def test_a_small_error_is_repaired(name: str, budget: int | None) -> None:
    found = align(group_aligner(name, budget_bytes=budget), pair(SE2(1.2, -0.8, math.radians(2.0))))["other"]
    distance, turn = error(found, TRUTH)
    assert distance < 0.1
    assert turn < 0.2


@BOTH
def test_a_right_pose_stays_right(name: str) -> None:
    distance, turn = error(align(group_aligner(name), pair(SE2()))["other"], TRUTH)
    assert distance < 0.05
    assert turn < 0.1


@BOTH
def test_a_large_error_is_not_repaired(name: str) -> None:
    """It is a refinement: from the ego's own place it does not find to where the other is."""
    observations = pair(SE2())
    observations["other"] = observed(cloud_of(scene(0), SE2(40.0, 3.0, 2.5), 2), EGO)
    found = align(group_aligner(name), observations)["other"]
    assert not found.accepted or error(found, EGO.inverse() @ SE2(40.0, 3.0, 2.5))[0] > 5.0


@BOTH
def test_each_collaborator_has_its_own_pose(name: str) -> None:
    world, third = scene(0), SE2(-5.0, 4.0, -1.0)
    observations = pair(SE2(0.5, 0.0, 0.01)) | {"third": observed(cloud_of(world, third, 3), third @ SE2(0.0, 0.6))}
    found = align(group_aligner(name), observations)
    assert error(found["other"], TRUTH)[0] < 0.1
    assert error(found["third"], EGO.inverse() @ third)[0] < 0.1


@BOTH
@pytest.mark.parametrize("count", [0, 1, 9])
@pytest.mark.parametrize("who", ["ego", "other"])
def test_too_few_points_keep_the_claimed_pose(name: str, count: int, who: str) -> None:
    observations = pair(SE2(0.5, 0.0, 0.0))
    few = observations[who].points
    assert few is not None
    observations[who] = Observation(points=few[:count], pose=observations[who].pose)
    found = align(group_aligner(name), observations)["other"]
    assert error(found, TRUTH @ SE2(0.5, 0.0, 0.0)) == pytest.approx((0.0, 0.0), abs=1e-9)


@BOTH
@pytest.mark.parametrize("kind", ["one place", "a line", "noise"])
def test_clouds_that_say_nothing_break_nothing(name: str, kind: str) -> None:
    rng = np.random.default_rng([1, 0, 0])
    cloud = np.zeros((300, 4), np.float32)
    if kind == "a line":
        cloud[:, 0] = np.linspace(-40.0, 40.0, 300)
    if kind == "noise":
        cloud[:, :3] = rng.uniform(-20.0, 20.0, (300, 3))
    found = align(group_aligner(name), {"ego": observed(cloud, EGO), "other": observed(cloud + 0.5, OTHER)})["other"]
    if found.ego_SE2_other is None:
        assert "diverged" in found.reason
    else:
        assert error(found, TRUTH)[0] <= 15.0


def test_diverging_registration_is_refused() -> None:
    """Two parallel walls without ends pin down no position along them; this step goes far along."""

    class Runaway(ICP2D):
        def refine(self, ego: FloatArray, other: FloatArray, ego_SE3_other: FloatArray) -> SE2:
            return super().refine(ego, other, ego_SE3_other) @ SE2(16.0, 0.0, 0.0)

    found = align(Runaway(), pair(SE2()))["other"]
    assert not found.accepted
    assert "diverged: 16.0 m and 0 degrees" in found.reason


def test_in_the_plane_lines_slide_along_each_other() -> None:
    """One wall fixes the turn and the distance from it, not the place along it: the claimed one stays."""
    rng = np.random.default_rng([2, 0, 0])
    wall = np.column_stack([rng.uniform(-20.0, 20.0, 800), np.full(800, 5.0)])
    truth, claimed = SE2(3.0, 1.0, 0.1), SE2(3.4, 0.4, 0.13)
    other = truth.inverse().apply(wall)
    found = planar_icp(wall, other, claimed, (5.0, 1.0))
    assert np.abs(found.apply(other)[:, 1] - 5.0).max() < 1e-3
    assert found.apply(other)[:, 0].mean() == pytest.approx(claimed.apply(other)[:, 0].mean(), abs=0.1)


def test_exact_points_give_the_exact_motion() -> None:
    rng = np.random.default_rng([3, 0, 0])
    points = rng.uniform(-20.0, 20.0, (60, 2))
    truth = SE2(-2.0, 7.0, 1.0)
    found = planar_icp(truth.apply(points), points, truth @ SE2(0.2, -0.1, 0.01), (2.0,))
    assert found.error_to(truth) == pytest.approx((0.0, 0.0), abs=1e-4)


@BOTH
def test_pairs_up_to_the_gate_distance_are_used(name: str) -> None:
    """From 3 m off, one narrow gate sees little of what belongs together; a wide one first does."""
    off = SE2(2.5, 1.6, 0.0)
    narrow, wide = (align(group_aligner(name, gates=gates), pair(off))["other"] for gates in ((0.5,), (5.0, 0.5)))
    assert error(wide, TRUTH)[0] < 0.1
    assert error(narrow, TRUTH)[0] > 0.5


@BOTH
@pytest.mark.parametrize("gates", [(), (0.0,), (1.0, -1.0), (math.nan,)])
def test_settings_are_checked(name: str, gates: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="gates"):
        group_aligner(name, gates=gates)


def test_missing_small_gicp_error_names_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "small_gicp", None)
    with pytest.raises(ModuleNotFoundError, match=r"pip install cobevglue\[registration\]"):
        align(ICP3D(), pair(SE2()))
    assert align(ICP2D(), pair(SE2()))["other"].accepted
