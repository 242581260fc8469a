"""Side and plan views of vehicle bodies, relative to length, height and width."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cobevglue.typing import BoolArray, FloatArray

__all__ = ["BODIES", "Body", "varied"]

_WINDOW = 0.12
"""Minimum height of windows: of the roof above the shoulder, relative to the vehicle's height."""


@dataclass(frozen=True, slots=True)
class Body:
    """A body, relative to length, height and half width, at S stations from the rear to the front.

    Attributes:
        along: (S,) positions of the stations, from the rear (0) to the front (1).
        shoulder: (S,) height of the shoulder.
        roof: (S,) height of the roof; that of the shoulder outside the cabin.
        half_width: (S,) half width at the shoulder.
        clearance: height of the sill.
        roof_width: half width of the roof relative to that at the shoulder.
        axles: positions of the axles.
        wheel: wheel radius relative to the height.
        mirror: protrusion of the mirrors on either side [m].
    """

    along: tuple[float, ...]
    shoulder: tuple[float, ...]
    roof: tuple[float, ...]
    half_width: tuple[float, ...]
    clearance: float = 0.17
    roof_width: float = 0.72
    axles: tuple[float, ...] = (0.19, 0.81)
    wheel: float = 0.215
    mirror: float = 0.10

    @property
    def profile(self) -> FloatArray:
        """(4, S) along, shoulder, roof and half width."""
        return np.array([self.along, self.shoulder, self.roof, self.half_width])

    @property
    def windows(self) -> BoolArray:
        """(S,) whether each station has windows."""
        _, shoulder, roof, _ = self.profile
        windows: BoolArray = roof - shoulder > _WINDOW
        return windows


BODIES: dict[str, tuple[Body, ...]] = {
    "sedan": (
        Body(
            along=(0.00, 0.02, 0.10, 0.20, 0.33, 0.45, 0.56, 0.72, 0.88, 0.96, 1.00),
            shoulder=(0.50, 0.64, 0.70, 0.70, 0.67, 0.66, 0.66, 0.65, 0.60, 0.53, 0.40),
            roof=(0.50, 0.64, 0.70, 0.73, 0.95, 1.00, 0.97, 0.67, 0.60, 0.53, 0.40),
            half_width=(0.70, 0.86, 0.95, 0.99, 1.00, 1.00, 1.00, 1.00, 0.96, 0.88, 0.64),
        ),
        Body(  # saloon: a long flat boot
            along=(0.00, 0.02, 0.10, 0.24, 0.34, 0.45, 0.55, 0.68, 0.86, 0.96, 1.00),
            shoulder=(0.55, 0.66, 0.69, 0.70, 0.68, 0.67, 0.67, 0.66, 0.63, 0.57, 0.42),
            roof=(0.55, 0.66, 0.69, 0.72, 0.96, 1.00, 0.97, 0.69, 0.63, 0.57, 0.42),
            half_width=(0.74, 0.90, 0.97, 1.00, 1.00, 1.00, 1.00, 1.00, 0.98, 0.92, 0.70),
            axles=(0.22, 0.81),
        ),
        Body(  # fastback
            along=(0.00, 0.02, 0.12, 0.28, 0.43, 0.55, 0.72, 0.90, 0.97, 1.00),
            shoulder=(0.48, 0.64, 0.70, 0.68, 0.66, 0.66, 0.64, 0.57, 0.49, 0.38),
            roof=(0.48, 0.64, 0.78, 0.93, 1.00, 0.97, 0.66, 0.57, 0.49, 0.38),
            half_width=(0.70, 0.87, 0.96, 1.00, 1.00, 1.00, 1.00, 0.95, 0.84, 0.62),
        ),
        Body(  # estate: the roof extends to the tail
            along=(0.00, 0.02, 0.05, 0.11, 0.35, 0.56, 0.72, 0.88, 0.96, 1.00),
            shoulder=(0.46, 0.62, 0.67, 0.69, 0.67, 0.66, 0.65, 0.60, 0.53, 0.40),
            roof=(0.46, 0.64, 0.84, 0.95, 1.00, 0.97, 0.67, 0.60, 0.53, 0.40),
            half_width=(0.72, 0.88, 0.95, 0.98, 1.00, 1.00, 1.00, 0.96, 0.88, 0.64),
        ),
        Body(  # long bonnet, the cabin far back
            along=(0.00, 0.02, 0.12, 0.20, 0.31, 0.40, 0.48, 0.62, 0.90, 0.98, 1.00),
            shoulder=(0.56, 0.68, 0.73, 0.72, 0.69, 0.68, 0.68, 0.67, 0.62, 0.52, 0.40),
            roof=(0.56, 0.68, 0.73, 0.76, 0.96, 1.00, 0.97, 0.70, 0.62, 0.52, 0.40),
            half_width=(0.72, 0.90, 0.98, 1.00, 1.00, 1.00, 1.00, 1.00, 0.97, 0.90, 0.72),
        ),
    ),
    "hatchback": (
        Body(
            along=(0.00, 0.02, 0.06, 0.13, 0.35, 0.55, 0.76, 0.90, 0.97, 1.00),
            shoulder=(0.42, 0.58, 0.64, 0.66, 0.65, 0.64, 0.63, 0.57, 0.48, 0.38),
            roof=(0.42, 0.60, 0.82, 0.95, 1.00, 0.97, 0.66, 0.57, 0.48, 0.38),
            half_width=(0.76, 0.88, 0.94, 0.99, 1.00, 1.00, 1.00, 0.95, 0.85, 0.66),
            axles=(0.17, 0.81),
        ),
        Body(  # city car: short bonnet, tall
            along=(0.00, 0.02, 0.07, 0.30, 0.58, 0.82, 0.95, 1.00),
            shoulder=(0.42, 0.60, 0.62, 0.62, 0.62, 0.60, 0.52, 0.38),
            roof=(0.42, 0.66, 0.92, 1.00, 0.97, 0.62, 0.52, 0.38),
            half_width=(0.80, 0.92, 0.97, 1.00, 1.00, 1.00, 0.90, 0.68),
            axles=(0.15, 0.84),
        ),
        Body(  # two boxes: a high bonnet, an upright windscreen, a flat roof
            along=(0.00, 0.015, 0.04, 0.09, 0.35, 0.60, 0.70, 0.90, 0.97, 1.00),
            shoulder=(0.44, 0.60, 0.64, 0.66, 0.65, 0.65, 0.64, 0.61, 0.54, 0.40),
            roof=(0.44, 0.64, 0.90, 0.98, 1.00, 0.98, 0.67, 0.61, 0.54, 0.40),
            half_width=(0.78, 0.90, 0.95, 0.98, 1.00, 1.00, 1.00, 0.96, 0.88, 0.70),
            axles=(0.16, 0.81),
        ),
        Body(  # one box: bonnet and windscreen in one line, the roof slopes to the tail
            along=(0.00, 0.02, 0.06, 0.20, 0.45, 0.60, 0.82, 0.94, 1.00),
            shoulder=(0.46, 0.58, 0.62, 0.62, 0.61, 0.61, 0.59, 0.50, 0.36),
            roof=(0.46, 0.66, 0.84, 0.95, 1.00, 0.96, 0.63, 0.50, 0.36),
            half_width=(0.78, 0.90, 0.95, 1.00, 1.00, 1.00, 0.99, 0.90, 0.66),
            axles=(0.17, 0.82),
        ),
    ),
    "suv": (
        Body(
            along=(0.00, 0.02, 0.06, 0.12, 0.40, 0.56, 0.72, 0.92, 0.98, 1.00),
            shoulder=(0.45, 0.60, 0.66, 0.68, 0.67, 0.66, 0.65, 0.60, 0.50, 0.40),
            roof=(0.45, 0.62, 0.86, 0.97, 1.00, 0.97, 0.68, 0.60, 0.50, 0.40),
            half_width=(0.76, 0.90, 0.96, 1.00, 1.00, 1.00, 1.00, 0.96, 0.87, 0.72),
            clearance=0.19,
            roof_width=0.76,
            wheel=0.21,
        ),
        Body(  # the roof slopes to a raked tail
            along=(0.00, 0.02, 0.09, 0.22, 0.42, 0.55, 0.71, 0.91, 0.98, 1.00),
            shoulder=(0.46, 0.62, 0.67, 0.68, 0.67, 0.66, 0.65, 0.59, 0.48, 0.38),
            roof=(0.46, 0.64, 0.76, 0.94, 1.00, 0.97, 0.67, 0.59, 0.48, 0.38),
            half_width=(0.74, 0.90, 0.96, 1.00, 1.00, 1.00, 1.00, 0.96, 0.87, 0.70),
            clearance=0.19,
            roof_width=0.75,
            wheel=0.21,
        ),
    ),
    "coupe": (
        Body(
            along=(0.00, 0.02, 0.12, 0.27, 0.42, 0.52, 0.67, 0.88, 0.96, 1.00),
            shoulder=(0.52, 0.66, 0.73, 0.71, 0.68, 0.67, 0.66, 0.58, 0.50, 0.38),
            roof=(0.52, 0.66, 0.76, 0.92, 1.00, 0.96, 0.69, 0.58, 0.50, 0.38),
            half_width=(0.68, 0.86, 0.97, 1.00, 1.00, 0.99, 0.99, 0.97, 0.87, 0.60),
            clearance=0.13,
            roof_width=0.68,
            wheel=0.235,
            axles=(0.19, 0.80),
        ),
        Body(  # open-top: no roof behind the windscreen
            along=(0.00, 0.03, 0.25, 0.30, 0.52, 0.53, 0.56, 0.66, 0.90, 0.97, 1.00),
            shoulder=(0.52, 0.68, 0.72, 0.50, 0.50, 0.69, 0.69, 0.67, 0.60, 0.52, 0.38),
            roof=(0.52, 0.68, 0.72, 0.50, 0.50, 0.98, 1.00, 0.70, 0.60, 0.52, 0.38),
            half_width=(0.70, 0.90, 1.00, 1.00, 1.00, 1.00, 1.00, 1.00, 0.96, 0.86, 0.62),
            clearance=0.14,
            wheel=0.235,
        ),
    ),
    "jeep": (
        Body(  # the spare wheel is at the rear
            along=(0.00, 0.05, 0.055, 0.30, 0.58, 0.68, 0.94, 0.96, 1.00),
            shoulder=(0.55, 0.56, 0.60, 0.60, 0.60, 0.60, 0.58, 0.40, 0.34),
            roof=(0.58, 0.60, 0.98, 1.00, 0.99, 0.62, 0.58, 0.40, 0.34),
            half_width=(0.30, 0.32, 0.88, 0.90, 0.90, 0.88, 0.80, 0.85, 0.80),
            clearance=0.24,
            roof_width=0.92,
            wheel=0.21,
            axles=(0.20, 0.83),
        ),
        Body(  # boxy cross-country car
            along=(0.00, 0.01, 0.04, 0.40, 0.60, 0.70, 0.96, 0.985, 1.00),
            shoulder=(0.45, 0.62, 0.64, 0.64, 0.63, 0.63, 0.60, 0.50, 0.38),
            roof=(0.45, 0.66, 0.97, 1.00, 0.98, 0.65, 0.60, 0.50, 0.38),
            half_width=(0.86, 0.94, 0.97, 1.00, 1.00, 1.00, 0.96, 0.92, 0.86),
            clearance=0.22,
            roof_width=0.84,
        ),
    ),
    "pickup": (
        Body(
            along=(0.00, 0.01, 0.04, 0.05, 0.37, 0.38, 0.42, 0.52, 0.60, 0.70, 0.95, 0.985, 1.00),
            shoulder=(0.40, 0.60, 0.61, 0.40, 0.40, 0.63, 0.63, 0.63, 0.63, 0.62, 0.58, 0.48, 0.38),
            roof=(0.40, 0.60, 0.61, 0.40, 0.40, 0.86, 0.98, 1.00, 0.97, 0.65, 0.58, 0.48, 0.38),
            half_width=(0.88, 0.96, 0.98, 0.98, 0.98, 1.00, 1.00, 1.00, 1.00, 1.00, 0.95, 0.88, 0.78),
            clearance=0.22,
            roof_width=0.80,
            axles=(0.22, 0.83),
        ),
        Body(  # a wedge: one edge across the roof, a cover that extends to the tail
            along=(0.00, 0.01, 0.30, 0.54, 0.82, 0.97, 1.00),
            shoulder=(0.58, 0.66, 0.65, 0.63, 0.58, 0.50, 0.38),
            roof=(0.58, 0.66, 0.83, 1.00, 0.64, 0.50, 0.38),
            half_width=(0.93, 0.96, 1.00, 1.00, 0.99, 0.95, 0.86),
            clearance=0.20,
            roof_width=0.80,
            axles=(0.20, 0.82),
        ),
    ),
    "van": (
        Body(
            along=(0.00, 0.01, 0.04, 0.45, 0.68, 0.85, 0.96, 1.00),
            shoulder=(0.40, 0.55, 0.55, 0.55, 0.54, 0.52, 0.42, 0.28),
            roof=(0.40, 0.95, 0.99, 1.00, 0.98, 0.56, 0.44, 0.28),
            half_width=(0.88, 0.94, 0.97, 1.00, 1.00, 0.98, 0.90, 0.74),
            clearance=0.14,
            roof_width=0.84,
            wheel=0.15,
            axles=(0.20, 0.83),
            mirror=0.15,
        ),
        Body(  # people carrier
            along=(0.00, 0.02, 0.06, 0.40, 0.62, 0.83, 0.96, 1.00),
            shoulder=(0.42, 0.58, 0.60, 0.60, 0.59, 0.56, 0.46, 0.34),
            roof=(0.42, 0.72, 0.95, 1.00, 0.97, 0.58, 0.46, 0.34),
            half_width=(0.84, 0.93, 0.97, 1.00, 1.00, 0.98, 0.90, 0.72),
            clearance=0.15,
            roof_width=0.80,
            wheel=0.18,
        ),
        Body(  # the driver sits above the front axle
            along=(0.00, 0.01, 0.06, 0.50, 0.88, 0.97, 1.00),
            shoulder=(0.42, 0.55, 0.55, 0.55, 0.54, 0.50, 0.32),
            roof=(0.42, 0.84, 0.97, 1.00, 0.96, 0.58, 0.32),
            half_width=(0.88, 0.94, 0.98, 1.00, 1.00, 0.96, 0.86),
            clearance=0.14,
            roof_width=0.82,
            wheel=0.16,
            axles=(0.20, 0.77),
            mirror=0.13,
        ),
    ),
    "truck": (
        Body(  # lorry with a box behind the cab
            along=(0.00, 0.35, 0.72, 0.725, 0.755, 0.76, 0.80, 0.93, 0.98, 1.00),
            shoulder=(0.97, 0.97, 0.97, 0.33, 0.33, 0.50, 0.50, 0.48, 0.44, 0.34),
            roof=(1.00, 1.00, 1.00, 0.33, 0.33, 0.84, 0.86, 0.80, 0.50, 0.36),
            half_width=(1.00, 1.00, 1.00, 0.80, 0.80, 0.94, 0.95, 0.95, 0.93, 0.86),
            clearance=0.22,
            roof_width=0.96,
            wheel=0.14,
            axles=(0.14, 0.26, 0.86),
            mirror=0.18,
        ),
        Body(  # bonneted lorry
            along=(0.00, 0.30, 0.60, 0.605, 0.625, 0.63, 0.76, 0.82, 0.96, 1.00),
            shoulder=(0.97, 0.97, 0.97, 0.33, 0.33, 0.52, 0.52, 0.50, 0.46, 0.30),
            roof=(1.00, 1.00, 1.00, 0.33, 0.33, 0.80, 0.80, 0.53, 0.46, 0.30),
            half_width=(1.00, 1.00, 1.00, 0.80, 0.80, 0.92, 0.92, 0.90, 0.84, 0.72),
            clearance=0.20,
            roof_width=0.96,
            wheel=0.14,
            axles=(0.14, 0.24, 0.87),
            mirror=0.18,
        ),
    ),
    "bus": (
        Body(
            along=(0.00, 0.01, 0.50, 0.96, 0.99, 1.00),
            shoulder=(0.45, 0.42, 0.42, 0.42, 0.40, 0.38),
            roof=(0.96, 0.99, 1.00, 0.99, 0.96, 0.90),
            half_width=(0.94, 0.99, 1.00, 1.00, 0.96, 0.90),
            clearance=0.10,
            roof_width=0.95,
            wheel=0.15,
            axles=(0.27, 0.75),
            mirror=0.18,
        ),
    ),
}
"""Side and plan views by kind of vehicle; equally likely where several are given."""

_SPREAD = 0.04
"""Relative standard deviation of heights and widths within a kind."""
_SHIFTS = (0.03, 0.02, 0.012)
"""Standard deviations of the amplitudes of the sine waves that shift the stations, relative to the length."""


def varied(body: Body, rng: np.random.Generator) -> Body:
    """A random variation of a body: positions of pillars, heights of boot and bonnet, widths.

    Args:
        body: the nominal body.
        rng: random generator.
    """
    along, shoulder, roof, half_width = body.profile
    spread = rng.normal(scale=_SPREAD, size=5)  # the fifth is unused: it keeps the random stream as it was
    shift = np.clip(rng.normal(size=len(_SHIFTS)), -1.7, 1.7) * _SHIFTS  # the bound preserves their order
    moved = along + np.sin(np.pi * np.outer(along, 1 + np.arange(len(shift)))) @ shift
    raised = 1.0 + spread[0] + spread[1] * (2.0 * along - 1.0)
    roof = np.where(body.windows, roof, roof * raised)
    corner = 1.0 - (1.0 - half_width) * np.exp(5.0 * spread[2])
    axles = tuple(float(np.interp(axle, along, moved)) for axle in body.axles)
    return Body(
        along=tuple(moved.tolist()),
        shoulder=tuple(np.minimum(shoulder * raised, 0.98).tolist()),
        roof=tuple(np.minimum(roof, 1.0).tolist()),
        half_width=tuple(np.clip(corner, 0.25, 1.0).tolist()),
        clearance=body.clearance * float(np.exp(rng.normal(scale=0.12))),
        roof_width=float(np.clip(body.roof_width * (1.0 + 0.5 * spread[3]), 0.5, 0.97)),
        axles=axles,
        wheel=body.wheel * float(np.exp(rng.normal(scale=0.05))),
        mirror=max(0.04, body.mirror + float(rng.normal(scale=0.03))),
    )
