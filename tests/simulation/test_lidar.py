"""A LiDAR against scenes whose returns can be worked out by hand."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from cobevglue.simulation.lidar import LIDARS, LidarSettings, RayScene, scan
from cobevglue.simulation.mesh import Mesh, box, quads
from cobevglue.typing import FloatArray

PERFECT = LidarSettings(range_noise=0.0, dropout=0.0, dropout_at_zero=0.0)


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def at(x: float, y: float, z: float, yaw: float = 0.0) -> FloatArray:
    c, s = math.cos(yaw), math.sin(yaw)
    return np.array([[c, -s, 0.0, x], [s, c, 0.0, y], [0.0, 0.0, 1.0, z], [0.0, 0.0, 0.0, 1.0]])


def ground(half: float = 500.0) -> Mesh:
    corners = [[-half, -half, 0.0], [half, -half, 0.0], [half, half, 0.0], [-half, half, 0.0]]
    return quads([corners])


def wall(x: float, transmission: float = 0.0) -> Mesh:
    """A wall across the x axis, far wider and higher than any sensor sees."""
    return quads([[[x, -900, -900], [x, 900, -900], [x, 900, 900], [x, -900, 900]]], transmission=transmission)


def test_the_default_sensor_is_opv2vs() -> None:
    """64 beams from -25 to 2 degrees and 1016 shots: the figures measured on an OPV2V cloud."""
    directions = LIDARS["opv2v"].directions().reshape(64, 1016, 3).astype(np.float64)
    elevation = np.degrees(np.arcsin(directions[:, 0, 2]))
    assert elevation == pytest.approx(np.linspace(-25.0, 2.0, 64), abs=1e-4)
    azimuth = np.degrees(np.arctan2(directions[10, :, 1], directions[10, :, 0]))
    assert np.diff(azimuth[1:]) == pytest.approx(360.0 / 1016, abs=1e-3)


def test_ground_rings_have_height_over_tangent_radius() -> None:
    settings = PERFECT.model_copy(update={"beams": 3, "elevation": (-30.0, -10.0), "shots": 90, "height": 2.0})
    points = scan((RayScene(ground()),), at(5.0, -3.0, 2.0), settings, rng()).points
    assert len(points) == 3 * 90
    assert points[:, 2] == pytest.approx(-2.0, abs=1e-4)
    radius = np.sort(np.hypot(points[:, 0], points[:, 1]))
    expected = np.repeat([2.0 / math.tan(math.radians(angle)) for angle in (30.0, 20.0, 10.0)], 90)
    assert radius == pytest.approx(expected, rel=1e-3)


def test_points_are_in_the_sensors_frame() -> None:
    """A wall 10 m ahead is at x = 10 wherever the sensor stands and looks."""
    scene = RayScene(wall(10.0).moved((3.0, 4.0, 1.0), 0.7))
    points = scan((scene,), at(3.0, 4.0, 1.0, yaw=0.7), PERFECT, rng()).points
    assert points[:, 0] == pytest.approx(10.0, abs=1e-3)


def test_nearer_objects_occlude_across_scenes() -> None:
    near, far = box((10.0, 0.0, 0.0), (1.0, 4.0, 4.0)), box((20.0, 0.0, 0.0), (1.0, 4.0, 4.0))
    for scenes in ((near, far), (far, near)):
        first, second = (RayScene(mesh, np.full(len(mesh), owner)) for mesh, owner in zip(scenes, (1, 2), strict=True))
        cloud = scan((first, second), at(0, 0, 0), PERFECT, rng())
        assert len(cloud.points)
        assert cloud.points[:, 0].max() < 10.5 + 1e-3
        assert set(cloud.owner) == {1 if scenes[0] is near else 2}


def test_nothing_comes_back_from_beyond_the_range() -> None:
    settings = PERFECT.model_copy(update={"range": 30.0})
    points = scan((RayScene(ground()),), at(0, 0, 1.9), settings, rng()).points
    assert np.linalg.norm(points[:, :3], axis=1).max() < 30.0


def test_an_empty_scene_gives_an_empty_cloud() -> None:
    cloud = scan((RayScene(Mesh.concatenate([])),), at(0, 0, 1.9), PERFECT, rng())
    assert cloud.points.shape == (0, 4)
    assert cloud.owner.shape == (0,)


@pytest.mark.parametrize("transmission", [0.0, 0.3, 1.0])
def test_glass_lets_its_share_of_rays_through(transmission: float) -> None:
    scenes = RayScene(wall(5.0, transmission)), RayScene(wall(8.0))
    points = scan(scenes, at(0, 0, 0), PERFECT, rng()).points
    ahead = points[:, 0] > 0
    behind_glass = points[ahead, 0] == pytest.approx(8.0, abs=0.02)
    assert np.isclose(points[ahead, 0], 5.0, atol=1e-3).mean() == pytest.approx(1.0 - transmission, abs=0.03)
    assert bool(behind_glass) == (transmission == 1.0)


def test_range_noise_is_along_ray_as_set() -> None:
    settings = PERFECT.model_copy(update={"range_noise": 0.05})
    scene = RayScene(ground())
    exact, noisy = (scan((scene,), at(0, 0, 2.0), s, rng()).points[:, :3] for s in (PERFECT, settings))
    distance = np.linalg.norm(exact, axis=1)
    assert (noisy / np.linalg.norm(noisy, axis=1)[:, None]) == pytest.approx(exact / distance[:, None], abs=1e-4)
    assert np.std(np.linalg.norm(noisy, axis=1) - distance) == pytest.approx(0.05, rel=0.05)


def test_intensity_and_drop_outs_follow_carlas_formulas() -> None:
    """Intensity exp(-a d); of points as weak as i, 0.4 (1 - i / 0.7) are lost beside the general tenth."""
    settings = LidarSettings(range_noise=0.0, attenuation=0.02, beams=64, elevation=(-0.5, 0.5), range=200.0)
    cloud = scan((RayScene(wall(60.0)),), at(0, 0, 0), settings, rng())
    distance = np.linalg.norm(cloud.points[:, :3], axis=1)
    assert cloud.points[:, 3] == pytest.approx(np.exp(-0.02 * distance), abs=1e-4)
    all_rays = scan((RayScene(wall(60.0)),), at(0, 0, 0), settings.model_copy(update=_nothing_lost()), rng())
    intensity = all_rays.points[:, 3].astype(np.float64)
    expected = (0.9 * (1.0 - 0.4 * np.clip(1.0 - intensity / 0.7, 0.0, 1.0))).sum()
    assert len(cloud.points) == pytest.approx(expected, rel=0.02)


def _nothing_lost() -> dict[str, float]:
    return {"dropout": 0.0, "dropout_at_zero": 0.0}


def test_surface_intensity_applies_where_measured() -> None:
    settings = PERFECT.model_copy(update={"intensity": "surface", "attenuation": 0.0, "beams": 1, "elevation": (0, 0)})
    mesh = Mesh.concatenate([wall(10.0), wall(-10.0)])
    mesh = replace(mesh, reflectivity=np.array([0.8, 0.8, 0.2, 0.2], dtype=np.float32))
    points = scan((RayScene(mesh),), at(0, 0, 0), settings, rng()).points
    head_on = np.abs(points[:, 1]) < 1.0
    front = points[:, 0] > 0
    assert points[head_on & front, 3] == pytest.approx(0.8, abs=0.01)
    assert points[head_on & ~front, 3] == pytest.approx(0.2, abs=0.01)


def test_the_same_seed_gives_the_same_bytes() -> None:
    scene = RayScene(ground())
    first, second = (scan((scene,), at(0, 0, 2.0), LidarSettings(), rng()).points.tobytes() for _ in range(2))
    assert first == second


@pytest.mark.parametrize(
    ("change", "field"), [({"beams": 0}, "beams"), ({"dropout": 1.5}, "dropout"), ({"rage": 3}, "range")]
)
def test_settings_out_of_range_or_unknown_are_errors(change: dict[str, float], field: str) -> None:
    with pytest.raises(ValueError, match=field):
        LidarSettings.model_validate(change)
