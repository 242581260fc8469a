"""FPFH and the robust motion: a pose out of nothing but points, or a refusal."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest

from cobevglue import SE2
from cobevglue.alignment import Observation
from cobevglue.alignment.registration import FPFHTeaser, fpfh

from .observations import align, cloud_of, error, scene

EGO, OTHER = SE2(2.0, -1.0, 0.3), SE2(6.0, -4.0, 2.5)
TRUTH = EGO.inverse() @ OTHER


def pair(seed: int = 0, other_seed: int | None = None) -> dict[str, Observation]:
    """Two agents at a street corner; or at different ones."""
    ego, other = scene(seed), scene(seed if other_seed is None else other_seed)
    return {
        "ego": Observation(points=cloud_of(ego, EGO, 1)),
        "other": Observation(points=cloud_of(other, OTHER, 2)),
    }


@pytest.mark.parametrize("seed", range(2))
def test_the_pose_is_found_without_any_claim(seed: int) -> None:
    distance, turn = error(align(FPFHTeaser(), pair(seed))["other"], TRUTH)
    assert distance < 0.5
    assert turn < 1.0


def test_the_same_clouds_give_the_same_pose() -> None:
    once, again = (align(FPFHTeaser(budget_bytes=15_000), pair())["other"].ego_SE2_other for _ in range(2))
    assert once == again


def test_unrelated_clouds_are_refused() -> None:
    """Streets of noise: nothing has a shape that could be taken for another."""
    rng = np.random.default_rng([4, 0, 0])
    ego, other = (
        Observation(points=np.column_stack([rng.uniform(-20.0, 20.0, (1500, 3)), np.zeros(1500)]).astype(np.float32))
        for _ in range(2)
    )
    found = align(FPFHTeaser(), {"ego": ego, "other": other})["other"]
    assert not found.accepted
    assert "matched points agree" in found.reason


@pytest.mark.parametrize("count", [0, 1, 9])
@pytest.mark.parametrize("who", ["ego", "other"])
def test_too_few_points_are_refused(count: int, who: str) -> None:
    observations = pair()
    points = observations[who].points
    assert points is not None
    observations[who] = Observation(points=points[:count])
    found = align(FPFHTeaser(), observations)["other"]
    assert not found.accepted
    assert found.reason == "too few points"


def test_points_in_one_place_are_refused() -> None:
    cloud = np.zeros((100, 4), np.float32)
    assert not align(FPFHTeaser(), {"ego": Observation(points=cloud), "other": pair()["other"]})["other"].accepted


def test_ego_alone_gives_no_poses() -> None:
    assert align(FPFHTeaser(), {"ego": pair()["ego"]}) == {}


@pytest.mark.parametrize("least", [0, 3, -1, math.nan])
def test_settings_are_checked(least: float) -> None:
    with pytest.raises(ValueError, match="min_inliers"):
        FPFHTeaser(min_inliers=least)  # type: ignore[arg-type]


def test_missing_open3d_error_names_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "open3d", None)
    fpfh._open3d.cache_clear()
    with pytest.raises(ModuleNotFoundError, match=r"pip install cobevglue\[registration\]"):
        align(FPFHTeaser(), pair())
    fpfh._open3d.cache_clear()


def test_libraries_are_imported_when_they_are_used() -> None:
    heavy = "torch", "open3d", "small_gicp", "scipy.spatial"
    code = f"import sys, cobevglue.alignment; print([m for m in {heavy} if m in sys.modules])"
    assert subprocess.check_output([sys.executable, "-c", code], text=True).strip() == "[]"
