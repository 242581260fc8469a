"""Bodies of vehicles in side view and plan view, as shares of their length, height and width."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cobevglue.typing import BoolArray, FloatArray

__all__ = ["BODIES", "Body", "varied"]

_WINDOW = 0.12
"""From this height of the roof above the shoulder on there are windows, in shares of the height."""


@dataclass(frozen=True, slots=True)
class Body:
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

    @property
    def profile(self) -> FloatArray:
        """(4, S) the stations: along, shoulder height, roof height, half width."""
        return np.array(self.stations).T

    @property
    def windows(self) -> BoolArray:
        """(S,) at which stations the roof is so far above the shoulder that there are windows."""
        _, shoulder, roof, _ = self.profile
        open_: BoolArray = roof - shoulder > _WINDOW
        return open_


BODIES: dict[str, tuple[Body, ...]] = {
    "sedan": (
        Body(
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
        Body(  # limousine: a long flat boot
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
        Body(  # fastback
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
        Body(  # estate: the roof goes on to the tail
            (
                (0.00, 0.46, 0.46, 0.72),
                (0.02, 0.62, 0.64, 0.88),
                (0.05, 0.67, 0.84, 0.95),
                (0.11, 0.69, 0.95, 0.98),
                (0.35, 0.67, 1.00, 1.00),
                (0.56, 0.66, 0.97, 1.00),
                (0.72, 0.65, 0.67, 1.00),
                (0.88, 0.60, 0.60, 0.96),
                (0.96, 0.53, 0.53, 0.88),
                (1.00, 0.40, 0.40, 0.64),
            )
        ),
        Body(  # long bonnet, the cabin far back
            (
                (0.00, 0.56, 0.56, 0.72),
                (0.02, 0.68, 0.68, 0.90),
                (0.12, 0.73, 0.73, 0.98),
                (0.20, 0.72, 0.76, 1.00),
                (0.31, 0.69, 0.96, 1.00),
                (0.40, 0.68, 1.00, 1.00),
                (0.48, 0.68, 0.97, 1.00),
                (0.62, 0.67, 0.70, 1.00),
                (0.90, 0.62, 0.62, 0.97),
                (0.98, 0.52, 0.52, 0.90),
                (1.00, 0.40, 0.40, 0.72),
            )
        ),
    ),
    "hatchback": (
        Body(
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
        Body(  # city car: short bonnet, tall
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
        Body(  # two boxes: a high bonnet, an upright windscreen, a flat roof
            (
                (0.00, 0.44, 0.44, 0.78),
                (0.015, 0.60, 0.64, 0.90),
                (0.04, 0.64, 0.90, 0.95),
                (0.09, 0.66, 0.98, 0.98),
                (0.35, 0.65, 1.00, 1.00),
                (0.60, 0.65, 0.98, 1.00),
                (0.70, 0.64, 0.67, 1.00),
                (0.90, 0.61, 0.61, 0.96),
                (0.97, 0.54, 0.54, 0.88),
                (1.00, 0.40, 0.40, 0.70),
            ),
            axles=(0.16, 0.81),
        ),
        Body(  # one box: the bonnet goes on in the windscreen, the roof falls to the tail
            (
                (0.00, 0.46, 0.46, 0.78),
                (0.02, 0.58, 0.66, 0.90),
                (0.06, 0.62, 0.84, 0.95),
                (0.20, 0.62, 0.95, 1.00),
                (0.45, 0.61, 1.00, 1.00),
                (0.60, 0.61, 0.96, 1.00),
                (0.82, 0.59, 0.63, 0.99),
                (0.94, 0.50, 0.50, 0.90),
                (1.00, 0.36, 0.36, 0.66),
            ),
            axles=(0.17, 0.82),
        ),
    ),
    "suv": (
        Body(
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
        Body(  # the roof falls to a raked tail
            (
                (0.00, 0.46, 0.46, 0.74),
                (0.02, 0.62, 0.64, 0.90),
                (0.09, 0.67, 0.76, 0.96),
                (0.22, 0.68, 0.94, 1.00),
                (0.42, 0.67, 1.00, 1.00),
                (0.55, 0.66, 0.97, 1.00),
                (0.71, 0.65, 0.67, 1.00),
                (0.91, 0.59, 0.59, 0.96),
                (0.98, 0.48, 0.48, 0.87),
                (1.00, 0.38, 0.38, 0.70),
            ),
            clearance=0.19,
            roof_width=0.75,
            wheel=0.21,
        ),
    ),
    "coupe": (
        Body(
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
        Body(  # open-top: no roof behind the windscreen
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
        Body(
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
        Body(  # boxy cross-country car
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
        Body(
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
        Body(  # a wedge: one edge across the roof, a cover that goes on to the tail
            (
                (0.00, 0.58, 0.58, 0.93),
                (0.01, 0.66, 0.66, 0.96),
                (0.30, 0.65, 0.83, 1.00),
                (0.54, 0.63, 1.00, 1.00),
                (0.82, 0.58, 0.64, 0.99),
                (0.97, 0.50, 0.50, 0.95),
                (1.00, 0.38, 0.38, 0.86),
            ),
            clearance=0.20,
            roof_width=0.80,
            axles=(0.20, 0.82),
        ),
    ),
    "van": (
        Body(
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
        Body(  # people carrier
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
        Body(  # the driver sits above the front axle
            (
                (0.00, 0.42, 0.42, 0.88),
                (0.01, 0.55, 0.84, 0.94),
                (0.06, 0.55, 0.97, 0.98),
                (0.50, 0.55, 1.00, 1.00),
                (0.88, 0.54, 0.96, 1.00),
                (0.97, 0.50, 0.58, 0.96),
                (1.00, 0.32, 0.32, 0.86),
            ),
            clearance=0.14,
            roof_width=0.82,
            wheel=0.16,
            axles=(0.20, 0.77),
            mirror=0.13,
        ),
    ),
    "truck": (
        Body(  # lorry with a box behind the cab
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
        Body(  # bonneted lorry
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
        Body(
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
"""Side and plan views by kind of vehicle; where there are several, each is as likely."""

_SPREAD = 0.04
"""Standard deviation, in shares, by which heights and widths differ within a kind."""
_SHIFTS = (0.03, 0.02, 0.012)
"""Standard deviation, in shares of the length, of the waves by which pillars are moved along it."""


def varied(body: Body, rng: np.random.Generator) -> Body:
    """The same kind of body, a little different: pillars further ahead or behind, boot and bonnet higher or lower.

    Args:
        body: what all of its kind are like.
        rng: for what differs; the same draws give the same body.
    """
    along, shoulder, roof, half_width = body.profile
    spread = rng.normal(scale=_SPREAD, size=5)  # one more than is used: without it all simulated cars would be others
    shift = np.clip(rng.normal(size=len(_SHIFTS)), -1.7, 1.7) * _SHIFTS  # so bounded, their order stays
    moved = along + np.sin(np.pi * np.outer(along, 1 + np.arange(len(shift)))) @ shift
    raised = 1.0 + spread[0] + spread[1] * (2.0 * along - 1.0)
    roof = np.where(body.windows, roof, roof * raised)
    corner = 1.0 - (1.0 - half_width) * np.exp(5.0 * spread[2])
    columns = moved, np.minimum(shoulder * raised, 0.98), np.minimum(roof, 1.0), np.clip(corner, 0.25, 1.0)
    axles = tuple(float(np.interp(axle, along, moved)) for axle in body.axles)
    return Body(
        tuple((float(a), float(b), float(c), float(d)) for a, b, c, d in np.stack(columns, axis=1)),
        clearance=body.clearance * float(np.exp(rng.normal(scale=0.12))),
        roof_width=float(np.clip(body.roof_width * (1.0 + 0.5 * spread[3]), 0.5, 0.97)),
        axles=axles,
        wheel=body.wheel * float(np.exp(rng.normal(scale=0.05))),
        mirror=max(0.04, body.mirror + float(rng.normal(scale=0.03))),
    )
