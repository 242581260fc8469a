"""Vehicles as shapes: a body lofted over cross sections, with cabin, windows, wheels and mirrors.

A body is given by its side view, a few stations from rear to front in shares of length and height, and by how it
narrows in the plan view; all of it varies from vehicle to vehicle. A LiDAR then sees what it sees of real cars: a
bonnet lower than the roof, round corners, sides that lean in, wheels below the sill, and mirrors that stick out, so
that the box around the vehicle (which counts them in, as CARLA's boxes do) is wider than its body.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cobevglue.simulation.mesh import Mesh, box, cylinder, ellipsoid, quads
from cobevglue.typing import FloatArray

__all__ = ["VEHICLE_KINDS", "vehicle_mesh"]


@dataclass(frozen=True, slots=True)
class _Body:
    """A body in shares: of the length from the rear (0) to the front (1), of the height, of the half width.

    Attributes:
        stations: (S, 4) along, shoulder height, roof height, half width; shoulder = roof where there is no cabin.
        clearance: height of the sill.
        roof_width: half width of the roof beside that at the shoulder.
        axles: where the wheels are, along.
        wheel: radius beside the height.
        mirror: how far mirrors stick out on either side [m].
    """

    stations: tuple[tuple[float, float, float, float], ...]
    clearance: float = 0.17
    roof_width: float = 0.72
    axles: tuple[float, ...] = (0.19, 0.81)
    wheel: float = 0.215
    mirror: float = 0.10


_BODIES: dict[str, tuple[_Body, ...]] = {
    "sedan": (
        _Body(
            (
                (0.00, 0.50, 0.50, 0.70),
                (0.02, 0.64, 0.64, 0.86),
                (0.10, 0.70, 0.70, 0.95),
                (0.20, 0.70, 0.73, 0.99),
                (0.33, 0.67, 0.95, 1.00),
                (0.45, 0.66, 1.00, 1.00),
                (0.56, 0.66, 0.97, 1.00),
                (0.72, 0.65, 0.67, 1.00),
                (0.88, 0.60, 0.60, 0.96),
                (0.96, 0.53, 0.53, 0.88),
                (1.00, 0.40, 0.40, 0.64),
            )
        ),
        _Body(  # limousine: a long flat boot
            (
                (0.00, 0.55, 0.55, 0.74),
                (0.02, 0.66, 0.66, 0.90),
                (0.10, 0.69, 0.69, 0.97),
                (0.24, 0.70, 0.72, 1.00),
                (0.34, 0.68, 0.96, 1.00),
                (0.45, 0.67, 1.00, 1.00),
                (0.55, 0.67, 0.97, 1.00),
                (0.68, 0.66, 0.69, 1.00),
                (0.86, 0.63, 0.63, 0.98),
                (0.96, 0.57, 0.57, 0.92),
                (1.00, 0.42, 0.42, 0.70),
            ),
            axles=(0.22, 0.81),
        ),
        _Body(  # fastback
            (
                (0.00, 0.48, 0.48, 0.70),
                (0.02, 0.64, 0.64, 0.87),
                (0.12, 0.70, 0.78, 0.96),
                (0.28, 0.68, 0.93, 1.00),
                (0.43, 0.66, 1.00, 1.00),
                (0.55, 0.66, 0.97, 1.00),
                (0.72, 0.64, 0.66, 1.00),
                (0.90, 0.57, 0.57, 0.95),
                (0.97, 0.49, 0.49, 0.84),
                (1.00, 0.38, 0.38, 0.62),
            )
        ),
    ),
    "hatchback": (
        _Body(
            (
                (0.00, 0.42, 0.42, 0.76),
                (0.02, 0.58, 0.60, 0.88),
                (0.06, 0.64, 0.82, 0.94),
                (0.13, 0.66, 0.95, 0.99),
                (0.35, 0.65, 1.00, 1.00),
                (0.55, 0.64, 0.97, 1.00),
                (0.76, 0.63, 0.66, 1.00),
                (0.90, 0.57, 0.57, 0.95),
                (0.97, 0.48, 0.48, 0.85),
                (1.00, 0.38, 0.38, 0.66),
            ),
            axles=(0.17, 0.81),
        ),
        _Body(  # city car: short bonnet, tall
            (
                (0.00, 0.42, 0.42, 0.80),
                (0.02, 0.60, 0.66, 0.92),
                (0.07, 0.62, 0.92, 0.97),
                (0.30, 0.62, 1.00, 1.00),
                (0.58, 0.62, 0.97, 1.00),
                (0.82, 0.60, 0.62, 1.00),
                (0.95, 0.52, 0.52, 0.90),
                (1.00, 0.38, 0.38, 0.68),
            ),
            axles=(0.15, 0.84),
        ),
    ),
    "suv": (
        _Body(
            (
                (0.00, 0.45, 0.45, 0.76),
                (0.02, 0.60, 0.62, 0.90),
                (0.06, 0.66, 0.86, 0.96),
                (0.12, 0.68, 0.97, 1.00),
                (0.40, 0.67, 1.00, 1.00),
                (0.56, 0.66, 0.97, 1.00),
                (0.72, 0.65, 0.68, 1.00),
                (0.92, 0.60, 0.60, 0.96),
                (0.98, 0.50, 0.50, 0.87),
                (1.00, 0.40, 0.40, 0.72),
            ),
            clearance=0.19,
            roof_width=0.76,
            wheel=0.21,
        ),
    ),
    "coupe": (
        _Body(
            (
                (0.00, 0.52, 0.52, 0.68),
                (0.02, 0.66, 0.66, 0.86),
                (0.12, 0.73, 0.76, 0.97),
                (0.27, 0.71, 0.92, 1.00),
                (0.42, 0.68, 1.00, 1.00),
                (0.52, 0.67, 0.96, 0.99),
                (0.67, 0.66, 0.69, 0.99),
                (0.88, 0.58, 0.58, 0.97),
                (0.96, 0.50, 0.50, 0.87),
                (1.00, 0.38, 0.38, 0.60),
            ),
            clearance=0.13,
            roof_width=0.68,
            wheel=0.235,
            axles=(0.19, 0.80),
        ),
        _Body(  # open-top: no roof behind the windscreen
            (
                (0.00, 0.52, 0.52, 0.70),
                (0.03, 0.68, 0.68, 0.90),
                (0.25, 0.72, 0.72, 1.00),
                (0.30, 0.50, 0.50, 1.00),
                (0.52, 0.50, 0.50, 1.00),
                (0.53, 0.69, 0.98, 1.00),
                (0.56, 0.69, 1.00, 1.00),
                (0.66, 0.67, 0.70, 1.00),
                (0.90, 0.60, 0.60, 0.96),
                (0.97, 0.52, 0.52, 0.86),
                (1.00, 0.38, 0.38, 0.62),
            ),
            clearance=0.14,
            wheel=0.235,
        ),
    ),
    "jeep": (
        _Body(
            (
                (0.00, 0.55, 0.58, 0.30),  # spare wheel
                (0.05, 0.56, 0.60, 0.32),
                (0.055, 0.60, 0.98, 0.88),
                (0.30, 0.60, 1.00, 0.90),
                (0.58, 0.60, 0.99, 0.90),
                (0.68, 0.60, 0.62, 0.88),
                (0.94, 0.58, 0.58, 0.80),
                (0.96, 0.40, 0.40, 0.85),
                (1.00, 0.34, 0.34, 0.80),
            ),
            clearance=0.24,
            roof_width=0.92,
            wheel=0.21,
            axles=(0.20, 0.83),
        ),
        _Body(  # boxy cross-country car
            (
                (0.00, 0.45, 0.45, 0.86),
                (0.01, 0.62, 0.66, 0.94),
                (0.04, 0.64, 0.97, 0.97),
                (0.40, 0.64, 1.00, 1.00),
                (0.60, 0.63, 0.98, 1.00),
                (0.70, 0.63, 0.65, 1.00),
                (0.96, 0.60, 0.60, 0.96),
                (0.985, 0.50, 0.50, 0.92),
                (1.00, 0.38, 0.38, 0.86),
            ),
            clearance=0.22,
            roof_width=0.84,
        ),
    ),
    "pickup": (
        _Body(
            (
                (0.00, 0.40, 0.40, 0.88),
                (0.01, 0.60, 0.60, 0.96),
                (0.04, 0.61, 0.61, 0.98),
                (0.05, 0.40, 0.40, 0.98),
                (0.37, 0.40, 0.40, 0.98),
                (0.38, 0.63, 0.86, 1.00),
                (0.42, 0.63, 0.98, 1.00),
                (0.52, 0.63, 1.00, 1.00),
                (0.60, 0.63, 0.97, 1.00),
                (0.70, 0.62, 0.65, 1.00),
                (0.95, 0.58, 0.58, 0.95),
                (0.985, 0.48, 0.48, 0.88),
                (1.00, 0.38, 0.38, 0.78),
            ),
            clearance=0.22,
            roof_width=0.80,
            axles=(0.22, 0.83),
        ),
    ),
    "van": (
        _Body(
            (
                (0.00, 0.40, 0.40, 0.88),
                (0.01, 0.55, 0.95, 0.94),
                (0.04, 0.55, 0.99, 0.97),
                (0.45, 0.55, 1.00, 1.00),
                (0.68, 0.54, 0.98, 1.00),
                (0.85, 0.52, 0.56, 0.98),
                (0.96, 0.42, 0.44, 0.90),
                (1.00, 0.28, 0.28, 0.74),
            ),
            clearance=0.14,
            roof_width=0.84,
            wheel=0.15,
            axles=(0.20, 0.83),
            mirror=0.15,
        ),
        _Body(  # people carrier
            (
                (0.00, 0.42, 0.42, 0.84),
                (0.02, 0.58, 0.72, 0.93),
                (0.06, 0.60, 0.95, 0.97),
                (0.40, 0.60, 1.00, 1.00),
                (0.62, 0.59, 0.97, 1.00),
                (0.83, 0.56, 0.58, 0.98),
                (0.96, 0.46, 0.46, 0.90),
                (1.00, 0.34, 0.34, 0.72),
            ),
            clearance=0.15,
            roof_width=0.80,
            wheel=0.18,
        ),
    ),
    "truck": (
        _Body(  # lorry with a box behind the cab
            (
                (0.00, 0.97, 1.00, 1.00),
                (0.35, 0.97, 1.00, 1.00),
                (0.72, 0.97, 1.00, 1.00),
                (0.725, 0.33, 0.33, 0.80),
                (0.755, 0.33, 0.33, 0.80),
                (0.76, 0.50, 0.84, 0.94),
                (0.80, 0.50, 0.86, 0.95),
                (0.93, 0.48, 0.80, 0.95),
                (0.98, 0.44, 0.50, 0.93),
                (1.00, 0.34, 0.36, 0.86),
            ),
            clearance=0.22,
            roof_width=0.96,
            wheel=0.14,
            axles=(0.14, 0.26, 0.86),
            mirror=0.18,
        ),
        _Body(  # bonneted lorry
            (
                (0.00, 0.97, 1.00, 1.00),
                (0.30, 0.97, 1.00, 1.00),
                (0.60, 0.97, 1.00, 1.00),
                (0.605, 0.33, 0.33, 0.80),
                (0.625, 0.33, 0.33, 0.80),
                (0.63, 0.52, 0.80, 0.92),
                (0.76, 0.52, 0.80, 0.92),
                (0.82, 0.50, 0.53, 0.90),
                (0.96, 0.46, 0.46, 0.84),
                (1.00, 0.30, 0.30, 0.72),
            ),
            clearance=0.20,
            roof_width=0.96,
            wheel=0.14,
            axles=(0.14, 0.24, 0.87),
            mirror=0.18,
        ),
    ),
    "bus": (
        _Body(
            (
                (0.00, 0.45, 0.96, 0.94),
                (0.01, 0.42, 0.99, 0.99),
                (0.50, 0.42, 1.00, 1.00),
                (0.96, 0.42, 0.99, 1.00),
                (0.99, 0.40, 0.96, 0.96),
                (1.00, 0.38, 0.90, 0.90),
            ),
            clearance=0.10,
            roof_width=0.95,
            wheel=0.15,
            axles=(0.27, 0.75),
            mirror=0.18,
        ),
    ),
}

VEHICLE_KINDS: tuple[str, ...] = (*_BODIES, "motorcycle")
"""Kinds that `vehicle_mesh` knows."""

_PAINT, _TYRE, _INSIDE = (0.2, 0.9), 0.1, 0.3
_CLEAR_GLASS_SHARE = 0.3
"""Share of vehicles with windows that let rays through; the others' are opaque, as all of CARLA's are."""
_CLEAR_GLASS = (0.4, 0.95)
_SPREAD = 0.04
"""Standard deviation, in shares, by which side views differ within a kind."""


def vehicle_mesh(kind: str, size: tuple[float, float, float], rng: np.random.Generator) -> Mesh:
    """A vehicle of this kind.

    Args:
        kind: one of `VEHICLE_KINDS`.
        size: length, width over the mirrors, height [m].
        rng: for what varies within a kind.

    Returns:
        Triangles in the vehicle's own frame: origin on the ground under the centre of the box, x forward. Their bounds
        are exactly the box of that size.

    Raises:
        ValueError: an unknown kind.
    """
    if kind == "motorcycle":
        mesh = _motorcycle(rng)
    elif kind in _BODIES:
        bodies = _BODIES[kind]
        mesh = _car(_varied(bodies[rng.integers(len(bodies))], rng), np.asarray(size), rng)
    else:
        raise ValueError(f"unknown kind of vehicle {kind!r}; there are: {', '.join(VEHICLE_KINDS)}")
    return _fitted(mesh, size)


def _varied(body: _Body, rng: np.random.Generator) -> _Body:
    """The same kind of body, a little different."""
    stations = np.array(body.stations)
    spread = rng.normal(scale=_SPREAD, size=4)
    shoulder = stations[:, 1] * (1.0 + spread[0])
    cabin = (stations[:, 2] - stations[:, 1]) > 0.1
    roof = np.where(cabin, stations[:, 2], stations[:, 2] * (1.0 + spread[0]))
    along = stations[:, 0] ** np.exp(0.6 * spread[1])
    corner = 1.0 - (1.0 - stations[:, 3]) * np.exp(5.0 * spread[2])
    varied = np.stack([along, np.minimum(shoulder, 0.98), np.minimum(roof, 1.0), np.clip(corner, 0.25, 1.0)], axis=1)
    return _Body(
        tuple((float(a), float(b), float(c), float(d)) for a, b, c, d in varied),
        clearance=body.clearance * float(np.exp(rng.normal(scale=0.12))),
        roof_width=float(np.clip(body.roof_width * (1.0 + 0.5 * spread[3]), 0.5, 0.97)),
        axles=body.axles,
        wheel=body.wheel * float(np.exp(rng.normal(scale=0.05))),
        mirror=max(0.04, body.mirror + float(rng.normal(scale=0.03))),
    )


def _car(body: _Body, size: FloatArray, rng: np.random.Generator) -> Mesh:
    length, width, height = size
    half_width = width / 2 - body.mirror
    paint = float(rng.uniform(*_PAINT))
    glass = float(rng.uniform(*_CLEAR_GLASS)) if rng.random() < _CLEAR_GLASS_SHARE else 0.0
    parts = [_shell(body, length, half_width, height, paint, glass)]
    if glass > 0.0:
        parts += _inside(length, half_width, height)
    radius = body.wheel * height
    tread = min(0.3, 0.28 * radius + 0.12)
    for axle in body.axles:
        x = (axle - 0.5) * length
        for side in (-1, 1):
            middle = (x, side * (half_width - tread / 2 + 0.015), radius)
            parts.append(cylinder(middle, radius, tread, _TYRE, axis="y"))
    stations = np.array(body.stations)
    windscreen = np.flatnonzero(stations[:, 2] - stations[:, 1] > 0.12)[-1]
    mirror_x = min((stations[windscreen, 0] - 0.5) * length + rng.uniform(0.05, 0.35), 0.5 * length - 0.15)
    mirror_z = stations[windscreen, 1] * height + 0.08
    for side in (-1, 1):
        middle = (mirror_x, side * (half_width + body.mirror / 2), mirror_z)
        parts.append(box(middle, (rng.uniform(0.1, 0.25), body.mirror, rng.uniform(0.1, 0.2)), reflectivity=paint))
    return Mesh.concatenate(parts)


def _shell(body: _Body, length: float, half_width: float, height: float, paint: float, glass: float) -> Mesh:
    """The loft: at each station a cross section from the underbody over sill, flank, shoulder and roof edge."""
    stations = np.array(body.stations)
    along, shoulder, roof, plan = stations.T
    x = (along - 0.5) * length
    w = plan * half_width
    low = np.full_like(along, body.clearance * height)
    low[[0, -1]] += 0.05 * height  # bumpers curve in from below
    shoulder_z, roof_z = shoulder * height, np.maximum(roof, shoulder) * height
    cabin = np.clip((roof - shoulder) / 0.3, 0.0, 1.0)
    roof_w = w * (0.92 - (0.92 - body.roof_width) * cabin)
    flank_z = low + 0.55 * (shoulder_z - low)
    crown = 0.03 * height
    section = np.stack(  # (stations, points of the right half, 3), from below to the middle of the roof
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
    opened = roof - shoulder > 0.12
    points = section.shape[1]
    side_windows = opened[:-1] & opened[1:]
    is_glass[:, 3] = is_glass[:, 2 * points - 6] = side_windows
    slanted = np.abs(np.diff(roof)) > 0.12 * np.maximum(np.diff(along), 0.05) / 0.1
    is_glass[:, 4 : 2 * points - 6] |= (slanted & (opened[:-1] | opened[1:]))[:, None]
    caps = [_fan(ring[0, :-1]), _fan(ring[-1, :-1])]
    return Mesh.concatenate(
        [quads(faces[~is_glass], paint), quads(faces[is_glass], 0.1, glass), *(Mesh.of(cap, paint) for cap in caps)]
    )


def _fan(outline: FloatArray) -> FloatArray:
    """(P, 3, 3) triangles from the middle of an outline (P, 3) to its edges."""
    middle = np.broadcast_to(outline.mean(axis=0), outline.shape)
    return np.stack([middle, outline, np.roll(outline, -1, axis=0)], axis=1)


def _inside(length: float, half_width: float, height: float) -> list[Mesh]:
    """What is seen through clear windows: a floor, two rows of seats, a dashboard."""
    width = 1.6 * half_width
    return [
        box((-0.02 * length, 0.0, 0.3 * height), (0.5 * length, width, 0.02), reflectivity=_INSIDE),
        box((-0.16 * length, 0.0, 0.55 * height), (0.12, width, 0.45 * height), reflectivity=_INSIDE),
        box((0.04 * length, 0.25 * width, 0.55 * height), (0.12, 0.35 * width, 0.45 * height), reflectivity=_INSIDE),
        box((0.04 * length, -0.25 * width, 0.55 * height), (0.12, 0.35 * width, 0.45 * height), reflectivity=_INSIDE),
        box((0.18 * length, 0.0, 0.5 * height), (0.2, width, 0.2 * height), reflectivity=_INSIDE),
    ]


def _motorcycle(rng: np.random.Generator) -> Mesh:
    """Two wheels, a frame with a tank, a handlebar, and a rider."""
    paint = float(rng.uniform(*_PAINT))
    lean = rng.uniform(0.0, 0.25)
    parts = [
        cylinder((-0.72, 0.0, 0.31), 0.31, 0.14, _TYRE, axis="y"),
        cylinder((0.72, 0.0, 0.31), 0.31, 0.12, _TYRE, axis="y"),
        box((0.0, 0.0, 0.6), (1.1, 0.26, 0.45), reflectivity=paint),
        box((-0.45, 0.0, 0.85), (0.7, 0.28, 0.12), reflectivity=_INSIDE),
        box((0.5, 0.0, 1.02), (0.08, 0.75, 0.08), reflectivity=paint),
    ]
    if rng.random() < 0.9:
        parts += [
            ellipsoid((-0.2 + lean, 0.0, 1.18), (0.17, 0.24, 0.34), _INSIDE),
            ellipsoid((-0.1 + 1.4 * lean, 0.0, 1.6), (0.14, 0.13, 0.15), paint),
            box((0.0, 0.2, 0.72), (0.5, 0.14, 0.16), reflectivity=_INSIDE),
            box((0.0, -0.2, 0.72), (0.5, 0.14, 0.16), reflectivity=_INSIDE),
        ]
    return Mesh.concatenate(parts)


def _fitted(mesh: Mesh, size: tuple[float, float, float]) -> Mesh:
    """Shifted and stretched so that its bounds are the box of this size, standing on the ground."""
    low, high = mesh.bounds()
    scale = np.asarray(size) / (high - low)
    middle = (low + high) / 2
    return mesh.moved((-middle[0] * scale[0], -middle[1] * scale[1], -low[2] * scale[2]), 0.0, scale).welded()
