"""Vehicles are of the size they should be, and look to a LiDAR like vehicles, not like boxes."""

from __future__ import annotations

import numpy as np
import pytest

from cobevglue.simulation.lidar import LidarSettings, RayScene
from cobevglue.simulation.mesh import Mesh
from cobevglue.simulation.traffic import VEHICLE_KINDS as TRAFFIC_KINDS
from cobevglue.simulation.vehicle_bodies import BODIES, Body, varied
from cobevglue.simulation.vehicle_shapes import VEHICLE_KINDS, vehicle_mesh
from cobevglue.typing import Float32Array

SIZES = {
    "sedan": (4.8, 2.1, 1.5),
    "hatchback": (3.8, 1.95, 1.5),
    "suv": (4.7, 2.2, 1.7),
    "coupe": (4.4, 2.0, 1.35),
    "jeep": (3.9, 1.9, 1.9),
    "pickup": (5.4, 2.2, 1.9),
    "van": (5.9, 2.3, 2.6),
    "truck": (8.5, 2.7, 3.6),
    "bus": (11.0, 2.7, 3.2),
    "motorcycle": (2.2, 0.85, 1.6),
}


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def heights_along(mesh: Mesh, x: Float32Array) -> Float32Array:
    """Height of the highest surface in the middle of the vehicle at these places along it; nan where there is none."""
    origins = np.column_stack([x, np.full(len(x), 0.01), np.full(len(x), 10.0)]).astype(np.float32)
    down = np.tile(np.array([0.0, 0.0, -1.0], dtype=np.float32), (len(x), 1))
    distance, _ = RayScene(mesh).first_hits(origins, down)
    height: Float32Array = np.where(np.isfinite(distance), 10.0 - distance, np.nan)
    return height


def test_every_kind_of_traffic_has_a_shape() -> None:
    assert set(TRAFFIC_KINDS) <= set(VEHICLE_KINDS) == set(SIZES)


@pytest.mark.parametrize("kind", VEHICLE_KINDS)
@pytest.mark.parametrize("seed", range(4))
def test_bounds_are_the_box(kind: str, seed: int) -> None:
    low, high = vehicle_mesh(kind, SIZES[kind], rng(seed)).bounds()
    length, width, height = SIZES[kind]
    assert low == pytest.approx([-length / 2, -width / 2, 0.0], abs=1e-4)
    assert high == pytest.approx([length / 2, width / 2, height], abs=1e-4)


@pytest.mark.parametrize(
    ("kind", "front"),
    [
        *((kind, 0.42) for kind in ("sedan", "hatchback", "suv", "jeep", "pickup")),
        ("van", 0.475),  # some have the driver above the front axle
    ],
)
@pytest.mark.parametrize("seed", range(8))
def test_bonnets_are_lower_than_roofs(kind: str, front: float, seed: int) -> None:
    length, _, height = SIZES[kind]
    mesh = vehicle_mesh(kind, SIZES[kind], rng(seed))
    heights = heights_along(mesh, np.array([-0.15, -0.05, 0.05, 0.1, front], dtype=np.float32) * length)
    assert heights[:4].max() > 0.9 * height
    assert heights[4] < 0.75 * height


@pytest.mark.parametrize(("kind", "body"), [(kind, body) for kind, bodies in BODIES.items() for body in bodies])
@pytest.mark.parametrize("seed", range(5))
def test_varied_body_keeps_part_order(kind: str, body: Body, seed: int) -> None:
    changed = varied(body, rng(seed))
    along, shoulder, roof, plan = changed.profile
    assert along[0] == 0.0
    assert along[-1] == pytest.approx(1.0)
    assert (np.diff(along) > 0.0).all()
    assert 0.0 < changed.axles[0] < changed.axles[-1] < 1.0
    for share in (shoulder, roof, plan):
        assert ((share > 0.0) & (share <= 1.0)).all()
    assert not np.allclose(along, body.along)


def test_every_body_has_windows() -> None:
    """Mirrors stand beside the foremost, and seats are seen through them."""
    for bodies in BODIES.values():
        for body in bodies:
            _, shoulder, roof, _ = body.profile
            assert (roof - shoulder).max() > 0.2


@pytest.mark.parametrize("kind", [kind for kind in VEHICLE_KINDS if kind != "motorcycle"])
def test_mirrors_make_the_box_wider_than_the_body(kind: str) -> None:
    """Few of the points that a LiDAR sees from the side lie within 3 cm of the box's side."""
    mesh = vehicle_mesh(kind, SIZES[kind], rng())
    length, width, height = SIZES[kind]
    x, z = (
        axis.ravel() for axis in np.meshgrid(np.linspace(-0.45, 0.45, 60) * length, np.linspace(0.3, 0.6, 20) * height)
    )
    origins = np.column_stack([x, np.full(len(x), 10.0), z]).astype(np.float32)
    sideways = np.tile(np.array([0.0, -1.0, 0.0], dtype=np.float32), (len(x), 1))
    distance, _ = RayScene(mesh).first_hits(origins, sideways)
    y = 10.0 - distance[np.isfinite(distance)]
    assert (y > 0.5 * width - 0.03).mean() < 0.08
    assert np.median(y) > 0.5 * width - 0.35


def test_wheels_touch_ground_and_sill_does_not() -> None:
    mesh = vehicle_mesh("sedan", SIZES["sedan"], rng())
    corners = mesh.triangles.reshape(-1, 3)
    touching = corners[corners[:, 2] < 0.05]
    axles = np.unique(np.sign(touching[:, 0]))
    assert axles.tolist() == [-1.0, 1.0]
    assert (np.abs(touching[:, 0]) > 0.2 * SIZES["sedan"][0]).all()


def test_some_windows_are_clear_and_some_are_not() -> None:
    clear = [bool((vehicle_mesh("suv", SIZES["suv"], rng(seed)).transmission > 0).any()) for seed in range(30)]
    assert 0 < sum(clear) < 30


def test_shapes_vary_and_are_reproducible() -> None:
    meshes = [vehicle_mesh("sedan", SIZES["sedan"], rng(seed)) for seed in (1, 1, 2)]
    assert np.array_equal(meshes[0].triangles, meshes[1].triangles)
    assert not np.array_equal(meshes[0].triangles.shape, meshes[2].triangles.shape) or not np.allclose(
        meshes[0].triangles, meshes[2].triangles
    )


def test_unknown_kind_error_lists_known_kinds() -> None:
    with pytest.raises(ValueError, match=r"'tank'.*sedan"):
        vehicle_mesh("tank", (5.0, 2.0, 2.0), rng())


def test_rays_over_bonnet_hit_windscreen() -> None:
    """Seen from the front the body's first surface at window height is behind the one at bumper height."""
    mesh = vehicle_mesh("sedan", SIZES["sedan"], rng())
    origins = np.array([[10.0, 0.1, 0.4], [10.0, 0.1, 1.25]], dtype=np.float32)
    backwards = np.tile(np.array([-1.0, 0.0, 0.0], dtype=np.float32), (2, 1))
    distance, _ = RayScene(mesh).first_hits(origins, backwards)
    assert distance[1] - distance[0] > 0.8
    assert LidarSettings().height > SIZES["sedan"][2]
