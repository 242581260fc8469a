"""Meshes of vehicles: a body lofted over cross sections, with cabin, windows, wheels and mirrors.

A body is defined by side view and plan view at a few stations, with random variations per vehicle. Features of real
cars that a LiDAR measures are modelled: a bonnet lower than the roof, round corners, inclined sides, wheels below the
sill, and mirrors, which make the bounding box (as CARLA's) wider than the body.
"""

from __future__ import annotations

import numpy as np

from cobevglue.simulation.mesh import Mesh, box, cylinder, ellipsoid, quads
from cobevglue.simulation.vehicle_bodies import BODIES, Body, varied
from cobevglue.typing import FloatArray

__all__ = ["VEHICLE_KINDS", "vehicle_mesh"]

VEHICLE_KINDS: tuple[str, ...] = (*BODIES, "motorcycle")
"""Kinds supported by `vehicle_mesh`."""

_PAINT, _TYRE, _INTERIOR = (0.2, 0.9), 0.1, 0.3
_CLEAR_GLASS_SHARE = 0.3
"""Share of vehicles with transmissive windows; the others' are opaque, as all of CARLA's."""
_CLEAR_GLASS = (0.4, 0.95)


def vehicle_mesh(kind: str, size: tuple[float, float, float], rng: np.random.Generator) -> Mesh:
    """Build the mesh of a random vehicle of this kind and size.

    Args:
        kind: one of `VEHICLE_KINDS`.
        size: length, width over the mirrors, height [m].
        rng: for variations within the kind.

    Returns:
        Triangles in the vehicle frame: origin on the ground below the centre of the box, x forward. Their bounding box
        has exactly this size.

    Raises:
        ValueError: an unknown kind.
    """
    if kind == "motorcycle":
        mesh = _motorcycle(rng)
    elif kind in BODIES:
        bodies = BODIES[kind]
        mesh = _car(varied(bodies[rng.integers(len(bodies))], rng), np.asarray(size), rng)
    else:
        raise ValueError(f"unknown kind of vehicle {kind!r}; known: {', '.join(VEHICLE_KINDS)}")
    return _fitted(mesh, size)


def _car(body: Body, size: FloatArray, rng: np.random.Generator) -> Mesh:
    length, width, height = size
    half_width = width / 2 - body.mirror
    paint = float(rng.uniform(*_PAINT))
    glass = float(rng.uniform(*_CLEAR_GLASS)) if rng.random() < _CLEAR_GLASS_SHARE else 0.0
    parts = [_shell(body, length, half_width, height, paint, glass)]
    along, shoulder, _, _ = body.profile
    rear_window, windscreen = np.flatnonzero(body.windows)[[0, -1]]
    if glass > 0.0:
        parts += _interior((along[rear_window], along[windscreen]), length, half_width, height)
    radius = body.wheel * height
    tread = min(0.3, 0.28 * radius + 0.12)
    for axle in body.axles:
        x = (axle - 0.5) * length
        for side in (-1, 1):
            middle = (x, side * (half_width - tread / 2 + 0.015), radius)
            parts.append(cylinder(middle, radius, tread, _TYRE, axis="y"))
    mirror_x = min((along[windscreen] - 0.5) * length + rng.uniform(0.05, 0.35), 0.5 * length - 0.15)
    mirror_z = shoulder[windscreen] * height + 0.08
    for side in (-1, 1):
        middle = (mirror_x, side * (half_width + body.mirror / 2), mirror_z)
        parts.append(box(middle, (rng.uniform(0.1, 0.25), body.mirror, rng.uniform(0.1, 0.2)), reflectivity=paint))
    return Mesh.concatenate(parts)


def _shell(body: Body, length: float, half_width: float, height: float, paint: float, glass: float) -> Mesh:
    """Loft of cross sections: at each station underbody, sill, flank, shoulder, roof edge and roof."""
    along, shoulder, roof, plan = body.profile
    x = (along - 0.5) * length
    w = plan * half_width
    low = np.full_like(along, body.clearance * height)
    low[[0, -1]] += 0.05 * height  # bumpers are rounded at the bottom
    shoulder_z, roof_z = shoulder * height, np.maximum(roof, shoulder) * height
    cabin = np.clip((roof - shoulder) / 0.3, 0.0, 1.0)
    roof_w = w * (0.92 - (0.92 - body.roof_width) * cabin)
    flank_z = low + 0.55 * (shoulder_z - low)
    crown = 0.03 * height
    section = np.stack(  # (stations, points of the right half, 3), from the bottom to the centre of the roof
        [
            np.stack([x, -0.8 * w, low], axis=1),
            np.stack([x, -0.96 * w, low + 0.04 * height], axis=1),
            np.stack([x, -w, flank_z], axis=1),
            np.stack([x, -0.95 * w, shoulder_z - 0.5 * crown], axis=1),
            np.stack([x, -roof_w, roof_z - crown], axis=1),
            np.stack([x, 0.0 * w, roof_z], axis=1),
        ],
        axis=1,
    )
    mirrored = section[:, ::-1] * np.array([1.0, -1.0, 1.0])
    ring = np.concatenate([section, mirrored[:, 1:]], axis=1)  # (stations, points all around, 3)
    ring = np.concatenate([ring, ring[:, :1]], axis=1)  # closed by the underbody
    faces = np.stack([ring[:-1, :-1], ring[1:, :-1], ring[1:, 1:], ring[:-1, 1:]], axis=2)
    is_glass = np.zeros(faces.shape[:2], dtype=bool)
    windows = body.windows
    points = section.shape[1]
    side_windows = windows[:-1] & windows[1:]
    is_glass[:, 3] = is_glass[:, 2 * points - 6] = side_windows
    slanted = np.abs(np.diff(roof)) > 0.12 * np.maximum(np.diff(along), 0.05) / 0.1
    is_glass[:, 4 : 2 * points - 6] |= (slanted & (windows[:-1] | windows[1:]))[:, None]
    caps = [_fan(ring[0, :-1]), _fan(ring[-1, :-1])]
    return Mesh.concatenate(
        [quads(faces[~is_glass], paint), quads(faces[is_glass], 0.1, glass), *(Mesh.of(cap, paint) for cap in caps)]
    )


def _fan(outline: FloatArray) -> FloatArray:
    """(P, 3, 3) triangles from the centroid of an outline (P, 3) to its edges."""
    middle = np.broadcast_to(outline.mean(axis=0), outline.shape)
    return np.stack([middle, outline, np.roll(outline, -1, axis=0)], axis=1)


def _interior(cabin: tuple[float, float], length: float, half_width: float, height: float) -> list[Mesh]:
    """Interior behind clear windows: a floor, two rows of seats, a dashboard.

    `cabin` is the start and end of the roof, from the rear, relative to the length.
    """
    rear, front = cabin
    width = 1.6 * half_width
    seat = 0.12, 0.35 * width, 0.45 * height
    back = (max(rear, front - 0.24) + 0.02 - 0.5) * length
    ahead = (front - 0.03 - 0.5) * length
    dashboard = (min(front + 0.1, 0.92) - 0.5) * length
    return [
        box(((back + dashboard) / 2, 0.0, 0.3 * height), (dashboard - back, width, 0.02), reflectivity=_INTERIOR),
        box((back, 0.0, 0.55 * height), (0.12, width, 0.45 * height), reflectivity=_INTERIOR),
        box((ahead, 0.25 * width, 0.55 * height), seat, reflectivity=_INTERIOR),
        box((ahead, -0.25 * width, 0.55 * height), seat, reflectivity=_INTERIOR),
        box((dashboard, 0.0, 0.5 * height), (0.2, width, 0.2 * height), reflectivity=_INTERIOR),
    ]


def _motorcycle(rng: np.random.Generator) -> Mesh:
    """Two wheels, a frame with a tank, a handlebar, and a rider."""
    paint = float(rng.uniform(*_PAINT))
    lean = rng.uniform(0.0, 0.25)
    parts = [
        cylinder((-0.72, 0.0, 0.31), 0.31, 0.14, _TYRE, axis="y"),
        cylinder((0.72, 0.0, 0.31), 0.31, 0.12, _TYRE, axis="y"),
        box((0.0, 0.0, 0.6), (1.1, 0.26, 0.45), reflectivity=paint),
        box((-0.45, 0.0, 0.85), (0.7, 0.28, 0.12), reflectivity=_INTERIOR),
        box((0.5, 0.0, 1.02), (0.08, 0.75, 0.08), reflectivity=paint),
    ]
    if rng.random() < 0.9:
        parts += [
            ellipsoid((-0.2 + lean, 0.0, 1.18), (0.17, 0.24, 0.34), _INTERIOR),
            ellipsoid((-0.1 + 1.4 * lean, 0.0, 1.6), (0.14, 0.13, 0.15), paint),
            box((0.0, 0.2, 0.72), (0.5, 0.14, 0.16), reflectivity=_INTERIOR),
            box((0.0, -0.2, 0.72), (0.5, 0.14, 0.16), reflectivity=_INTERIOR),
        ]
    return Mesh.concatenate(parts)


def _fitted(mesh: Mesh, size: tuple[float, float, float]) -> Mesh:
    """Translate and scale the mesh to the box of this size on the ground."""
    low, high = mesh.bounds()
    scale = np.asarray(size) / (high - low)
    middle = (low + high) / 2
    return mesh.moved((-middle[0] * scale[0], -middle[1] * scale[1], -low[2] * scale[2]), 0.0, scale).welded()
