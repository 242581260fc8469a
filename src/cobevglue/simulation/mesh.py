"""Triangle meshes with reflectivity and transmission for a LiDAR, and geometric primitives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from cobevglue.typing import ArrayLike, Float32Array, Int32Array

__all__ = ["Mesh", "box", "cylinder", "ellipsoid", "leaves", "quads"]


@dataclass(frozen=True, eq=False, slots=True)
class Mesh:
    """T triangles over V vertices.

    Attributes:
        vertices: (V, 3) float32 [m], axes x forward, y left, z up.
        faces: (T, 3) int32 rows of `vertices`.
        reflectivity: (T,) float32 reflected share of the light, 0 to 1.
        transmission: (T,) float32 probability that a ray passes through: 0 for a wall, near 1 for clear glass.
    """

    vertices: Float32Array
    faces: Int32Array
    reflectivity: Float32Array
    transmission: Float32Array

    @staticmethod
    def of(triangles: ArrayLike, reflectivity: float = 0.5, transmission: float = 0.0) -> Mesh:
        """Triangles (T, 3, 3) of one material."""
        vertices = np.asarray(triangles, dtype=np.float32).reshape(-1, 3)
        count = len(vertices) // 3
        return Mesh(
            vertices,
            np.arange(len(vertices), dtype=np.int32).reshape(-1, 3),
            np.full(count, reflectivity, dtype=np.float32),
            np.full(count, transmission, dtype=np.float32),
        )

    @staticmethod
    def concatenate(meshes: Sequence[Mesh]) -> Mesh:
        """Concatenate the triangles of several meshes in order."""
        if not meshes:
            return Mesh.of(np.zeros((0, 3, 3)))
        first = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])], dtype=np.int32)
        return Mesh(
            np.concatenate([mesh.vertices for mesh in meshes]),
            np.concatenate([mesh.faces + start for mesh, start in zip(meshes, first, strict=True)]),
            np.concatenate([mesh.reflectivity for mesh in meshes]),
            np.concatenate([mesh.transmission for mesh in meshes]),
        )

    def __len__(self) -> int:
        return len(self.faces)

    @property
    def triangles(self) -> Float32Array:
        """(T, 3, 3) the corners of each triangle [m]."""
        return self.vertices[self.faces]

    def welded(self) -> Mesh:
        """Merge identical vertices, which makes transforms and scene construction cheaper."""
        vertices, row = np.unique(self.vertices, axis=0, return_inverse=True)
        return replace(self, vertices=vertices, faces=row.reshape(-1).astype(np.int32)[self.faces])

    def moved(self, xyz: ArrayLike, yaw: float = 0.0, scale: ArrayLike = 1.0) -> Mesh:
        """Scale about the origin, rotate about z by `yaw` [rad], then translate by `xyz` [m]."""
        c, s = np.cos(yaw), np.sin(yaw)
        turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        vertices = (self.vertices * np.asarray(scale, dtype=np.float64)) @ turn.T + np.asarray(xyz, dtype=np.float64)
        return replace(self, vertices=vertices.astype(np.float32))

    def bounds(self) -> tuple[Float32Array, Float32Array]:
        """(3,) lower and (3,) upper corner of the axis-aligned bounding box."""
        return self.vertices.min(axis=0), self.vertices.max(axis=0)


def box(center: ArrayLike, size: ArrayLike, yaw: float = 0.0, reflectivity: float = 0.5) -> Mesh:
    """A closed cuboid: (3,) centre [m], (3,) size along its own axes [m]."""
    return Mesh.of(_unit_box(), reflectivity).moved(center, yaw, size)


def cylinder(
    center: ArrayLike, radius: float, height: float, reflectivity: float = 0.5, axis: str = "z", sides: int = 8
) -> Mesh:
    """A closed cylinder with its centre [m], radius [m] and height [m] along the axis "z" or "y"."""
    corners = _unit_cylinder(sides) * np.array([radius, radius, height], dtype=np.float32)
    if axis == "y":
        corners = corners[:, :, [0, 2, 1]]
    return Mesh.of(corners + np.asarray(center, dtype=np.float32), reflectivity)


def ellipsoid(center: ArrayLike, radii: ArrayLike, reflectivity: float = 0.5) -> Mesh:
    """A coarse ellipsoid of 80 triangles: (3,) centre and (3,) half axes [m]."""
    return Mesh.of(_unit_sphere(), reflectivity).moved(center, 0.0, radii)


def leaves(
    center: ArrayLike,
    radii: ArrayLike,
    count: int,
    rng: np.random.Generator,
    leaf: float = 0.5,
    reflectivity: float = 0.4,
) -> Mesh:
    """Foliage: `count` random triangles with edges of about `leaf` [m] inside an ellipsoid."""
    direction = rng.normal(size=(count, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    middle = direction * rng.uniform(0.3, 1.0, size=(count, 1)) ** (1 / 3) * np.asarray(radii, dtype=np.float64)
    corners = middle[:, None, :] + rng.normal(scale=leaf / 2, size=(count, 3, 3))
    return Mesh.of(corners + np.asarray(center, dtype=np.float64), reflectivity)


def quads(corners: ArrayLike, reflectivity: float = 0.5, transmission: float = 0.0) -> Mesh:
    """Two triangles for each of Q quadrilaterals with corners (Q, 4, 3) in order around the face."""
    faces = np.asarray(corners, dtype=np.float32).reshape(-1, 4, 3)
    return Mesh.of(np.concatenate([faces[:, [0, 1, 2]], faces[:, [0, 2, 3]]]), reflectivity, transmission)


@cache
def _unit_box() -> Float32Array:
    import trimesh

    return np.asarray(trimesh.creation.box().triangles, dtype=np.float32)


@cache
def _unit_cylinder(sides: int) -> Float32Array:
    import trimesh

    return np.asarray(trimesh.creation.cylinder(radius=1.0, height=1.0, sections=sides).triangles, dtype=np.float32)


@cache
def _unit_sphere() -> Float32Array:
    import trimesh

    return np.asarray(trimesh.creation.icosphere(subdivisions=1).triangles, dtype=np.float32)
