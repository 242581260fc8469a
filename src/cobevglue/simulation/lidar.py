"""A spinning LiDAR: ray casting of a beam table through a triangle mesh with Embree, with noise and drop-outs.

The default is OPV2V's configuration of CARLA's ray-cast LiDAR: 64 beams from -25 to +2 degrees, 1016 points per beam
and revolution, 120 m range, 2 cm range noise, 10 % drop-out, all points measured at the same time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache, cached_property
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field

from cobevglue.settings import Settings
from cobevglue.simulation.mesh import Mesh
from cobevglue.typing import Float32Array, FloatArray, IntArray

__all__ = ["LIDARS", "Cloud", "LidarSettings", "RayScene", "scan"]

_BACKGROUND = -1
_BEYOND_SURFACE = 0.01
"""A transmitted ray starts again at this distance behind the surface [m]."""
_MAX_SURFACES = 3
"""A ray transmitted by this many surfaces has no return."""

_Share = Annotated[float, Field(ge=0.0, le=1.0)]
_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


class LidarSettings(Settings):
    """Settings of a LiDAR.

    Attributes:
        beams: number of rings.
        elevation: elevation of the lowest and the highest ring [degrees], positive upwards.
        shots: points per ring and revolution.
        range: maximum range [m].
        height: height above the ground [m].
        range_noise: standard deviation along the ray [m].
        angle_noise: standard deviation of azimuth and elevation [degrees]; 0 in CARLA.
        dropout: drop-out probability of every point.
        dropout_intensity: points below this intensity have an additional drop-out probability, which grows linearly …
        dropout_at_zero: … to this value at intensity 0.
        attenuation: decay of the intensity with distance [1/m]: exp(-attenuation * distance).
        intensity: "distance": the same reflectivity for all surfaces, as in CARLA; "surface": by the reflectivity and
            the angle of incidence.
    """

    beams: Annotated[int, Field(ge=1, le=512)] = 64
    elevation: tuple[float, float] = (-25.0, 2.0)
    shots: Annotated[int, Field(ge=4, le=10_000)] = 1016
    range: _Positive = 120.0
    height: _Positive = 1.9
    range_noise: Annotated[float, Field(ge=0.0, le=1.0)] = 0.02
    angle_noise: Annotated[float, Field(ge=0.0, le=1.0)] = 0.0
    dropout: _Share = 0.1
    dropout_intensity: _Share = 0.7
    dropout_at_zero: _Share = 0.4
    attenuation: Annotated[float, Field(ge=0.0, le=1.0)] = 0.004
    intensity: Literal["distance", "surface"] = "distance"

    def directions(self) -> Float32Array:
        """(beams * shots, 3) unit vectors in the LiDAR frame; rings from the lowest, azimuth from -180 degrees."""
        return _directions(self.beams, self.elevation, self.shots)


LIDARS: dict[str, LidarSettings] = {
    "opv2v": LidarSettings(),
    "beams32": LidarSettings(
        beams=32, elevation=(-30.67, 10.67), shots=1800, range=100.0, angle_noise=0.02, intensity="surface"
    ),
    "beams16": LidarSettings(
        beams=16, elevation=(-15.0, 15.0), shots=1800, range=100.0, angle_noise=0.02, intensity="surface"
    ),
    "roadside": LidarSettings(elevation=(-40.0, 0.0), height=5.0),
}
"""Sensors by name: OPV2V's, two typical automotive ones with 32 and 16 beams, and one for roadside units."""


@dataclass(frozen=True, eq=False, slots=True)
class Cloud:
    """One revolution of the sensor.

    Attributes:
        points: (N, 4) float32 x, y, z [m] in the LiDAR frame, and intensity in [0, 1].
        owner: (N,) object id of each point, -1 for the background.
    """

    points: Float32Array
    owner: IntArray


class RayScene:
    """A triangle mesh with an acceleration structure for ray casting.

    Attributes:
        mesh: the triangles, in the world frame.
        owner: (T,) object id of each triangle, -1 for the background.
        transmissive: whether any triangle transmits rays.
    """

    def __init__(self, mesh: Mesh, owner: IntArray | None = None) -> None:
        """Build the acceleration structure.

        Raises:
            ModuleNotFoundError: embreex is not installed.
        """
        self.mesh = mesh
        self.owner = np.full(len(mesh), _BACKGROUND, dtype=np.int64) if owner is None else owner
        self.transmissive = bool((mesh.transmission > 0.0).any())
        self._embree: Any = None
        if len(mesh):
            try:
                from embreex.mesh_construction import TriangleMesh
                from embreex.rtcore_scene import EmbreeScene
            except ModuleNotFoundError as error:
                raise ModuleNotFoundError(
                    "LiDAR simulation needs embreex: pip install 'cobevglue[simulation]'"
                ) from error
            self._embree = EmbreeScene()
            TriangleMesh(self._embree, mesh.vertices, mesh.faces)

    def first_hits(self, origins: Float32Array, directions: Float32Array) -> tuple[Float32Array, IntArray]:
        """(R,) distance [m] to the first triangle along each ray, infinite without a hit; (R,) its index or -1."""
        if self._embree is None:
            return np.full(len(origins), np.inf, dtype=np.float32), np.full(len(origins), -1, dtype=np.int32)
        hits = self._embree.run(origins, directions, output=True)
        distance, row = hits["tfar"], hits["primID"]
        distance[row < 0] = np.inf
        return distance, row

    @cached_property
    def normals(self) -> Float32Array:
        """(T, 3) unit normals of the triangles."""
        corners = self.mesh.triangles
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        unit: Float32Array = normal / np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        return unit


def scan(
    scenes: tuple[RayScene, ...], world_SE3_lidar: FloatArray, settings: LidarSettings, rng: np.random.Generator
) -> Cloud:
    """Simulate one revolution of the sensor at a fixed pose.

    Args:
        scenes: triangles in the world frame; a ray ends at the nearest hit in any scene.
        world_SE3_lidar: (4, 4) pose of the sensor.
        settings: of the sensor.
        rng: for noise, drop-outs and transmission.
    """
    local = _noisy(settings.directions(), settings.angle_noise, rng)
    rotation = world_SE3_lidar[:3, :3].astype(np.float32)
    # Not `local @ rotation.T`: BLAS threads would compete with other processes for the cores.
    directions = local[:, :1] * rotation[:, 0] + local[:, 1:2] * rotation[:, 1] + local[:, 2:] * rotation[:, 2]
    start = world_SE3_lidar[:3, 3].astype(np.float32)
    hits = _opaque_hits(scenes, start, directions, rng)
    returned = np.flatnonzero(hits.distance < settings.range)
    distance = hits.distance[returned]
    intensity = np.exp(-settings.attenuation * distance)
    if settings.intensity == "surface":
        intensity = intensity * _reflected(scenes, hits, directions, returned)
    weak = settings.dropout_at_zero * np.clip(1.0 - intensity / max(settings.dropout_intensity, 1e-6), 0.0, 1.0)
    kept = rng.random(len(returned), dtype=np.float32) < (1.0 - settings.dropout) * (1.0 - weak)
    row = returned[kept]
    noisy = distance[kept] + settings.range_noise * rng.standard_normal(len(row), dtype=np.float32)
    points = np.empty((len(row), 4), dtype=np.float32)
    points[:, :3] = local[row] * noisy[:, None]
    points[:, 3] = intensity[kept]
    owner = np.full(len(row), _BACKGROUND, dtype=np.int64)
    for number, scene in enumerate(scenes):
        here = hits.scene[row] == number
        owner[here] = scene.owner[hits.triangle[row[here]]]
    return Cloud(points, owner)


@dataclass(frozen=True, eq=False, slots=True)
class _Hits:
    """(R,) hit of each ray: distance [m], infinite without a hit; index of the scene; index of the triangle in it."""

    distance: Float32Array
    scene: IntArray
    triangle: IntArray


def _opaque_hits(
    scenes: tuple[RayScene, ...], start: Float32Array, directions: Float32Array, rng: np.random.Generator
) -> _Hits:
    """Cast rays from one point to the first surface that does not transmit them."""
    hits = _nearest_hits(scenes, np.tile(start, (len(directions), 1)), directions)
    active = np.arange(len(directions))
    last = hits
    for surface in range(_MAX_SURFACES):
        transmission = np.zeros(len(active), dtype=np.float32)
        for number, scene in enumerate(scenes):
            if scene.transmissive:
                here = np.flatnonzero((last.scene == number) & np.isfinite(last.distance))
                transmission[here] = scene.mesh.transmission[last.triangle[here]]
        through = np.flatnonzero(transmission > 0.0)
        through = through[rng.random(len(through)) < transmission[through]]
        if not len(through):
            break
        active = active[through]
        travelled = hits.distance[active] + np.float32(_BEYOND_SURFACE)
        if surface + 1 == _MAX_SURFACES:
            hits.distance[active] = np.inf
            break
        onwards = directions[active]
        last = _nearest_hits(scenes, start + onwards * travelled[:, None], onwards)
        hits.distance[active] = travelled + last.distance
        hits.scene[active], hits.triangle[active] = last.scene, last.triangle
    return hits


def _nearest_hits(scenes: tuple[RayScene, ...], origins: Float32Array, directions: Float32Array) -> _Hits:
    """The nearest hit of each ray in all scenes."""
    distance, triangle = scenes[0].first_hits(origins, directions)
    of_scene = np.zeros(len(origins), dtype=np.int64)
    for number, scene in enumerate(scenes[1:], start=1):
        other, row = scene.first_hits(origins, directions)
        nearer = other < distance
        np.copyto(distance, other, where=nearer)
        np.copyto(triangle, row, where=nearer)
        of_scene[nearer] = number
    return _Hits(distance, of_scene, triangle)


def _reflected(scenes: tuple[RayScene, ...], hits: _Hits, directions: Float32Array, rays: IntArray) -> Float32Array:
    """(len(rays),) reflected share: the surface's reflectivity times the square root of the cosine of incidence."""
    share = np.zeros(len(rays), dtype=np.float32)
    for number, scene in enumerate(scenes):
        here = np.flatnonzero(hits.scene[rays] == number)
        row = hits.triangle[rays[here]]
        cosine = np.abs((scene.normals[row] * directions[rays[here]]).sum(axis=1))
        share[here] = scene.mesh.reflectivity[row] * np.sqrt(cosine)
    return share


@cache
def _directions(beams: int, degrees: tuple[float, float], shots: int) -> Float32Array:
    elevation = np.radians(np.linspace(*degrees, beams))[:, None]
    azimuth = (np.arange(shots) / shots * 2.0 - 1.0)[None, :] * np.pi
    directions = _unit_vectors(azimuth, elevation).reshape(-1, 3).astype(np.float32)
    directions.setflags(write=False)
    return directions


def _noisy(directions: Float32Array, degrees: float, rng: np.random.Generator) -> Float32Array:
    if degrees == 0.0:
        return directions
    sigma = np.radians(degrees)
    azimuth = np.arctan2(directions[:, 1], directions[:, 0]) + rng.normal(scale=sigma, size=len(directions))
    elevation = np.arcsin(directions[:, 2]) + rng.normal(scale=sigma, size=len(directions))
    return _unit_vectors(azimuth, elevation).astype(np.float32)


def _unit_vectors(azimuth: FloatArray, elevation: FloatArray) -> FloatArray:
    """(…, 3) unit vectors for broadcastable angles [rad]."""
    azimuth, elevation = np.broadcast_arrays(azimuth, elevation)
    flat = np.cos(elevation)
    return np.stack([flat * np.cos(azimuth), flat * np.sin(azimuth), np.sin(elevation)], axis=-1)
