"""How much a pair of boxes speaks for being one object: log-likelihood ratios in nats (numba kernels).

Under a hypothetical relative pose, a pair of boxes (m of ego, n of other) leaves a residual in position, heading and
size. Its *evidence* is log p(residual | same object) - log p(residual | two objects that happen to lie there). This
replaces the thresholded affinities of the paper (section 4.2, phi_V and phi_E; their formulas are in an appendix that
is not public): a node's affinity becomes `size_evidence`, an edge's becomes `pair_evidence`, and the size of a common
subgraph becomes the sum of both over its nodes, so that five vague agreements do not outvote four exact ones.

Box rows here are (x, y, length, width, yaw) in metres and radians, each list in its own agent's frame; those of the
other agent are followed by the velocity over ground (vx, vy) along the axes of its frame in m/s.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from cobevglue._kernels import kernel
from cobevglue.typing import FloatArray

X, Y, LENGTH, WIDTH, YAW, VX, VY = range(7)

_SQRT_2PI = math.sqrt(2.0 * math.pi)
_HEADING_TAIL_SHARE, _HEADING_TAIL_WIDTH = 0.25, 3.5
"""A quarter of the headings of one object differ several times more than the rest (far or half-seen boxes)."""
_ROAD_SHARE, _ROAD_STD = 0.6, 0.15
"""Two unrelated vehicles are not oriented at random: most follow the same road (share, standard deviation [rad])."""


class NoiseModel(NamedTuple):
    """What the evidence assumes of two detectors; see `BEVGlueConfig` for meanings, units and measurements."""

    position_std: float
    heading_std: float
    length_std: float
    width_std: float
    size_gain: float
    density: float
    flip_probability: float
    use_size: bool
    use_flips: bool
    use_range_tolerance: bool
    one_to_one: bool


@kernel(error_model="numpy")
def wrap(angle: float) -> float:
    """The same angle in [-pi, pi)."""
    return (angle + math.pi) % (2.0 * math.pi) - math.pi


@kernel(error_model="numpy")
def wrap_half_turn(angle: float) -> float:
    """The same axis in [-pi/2, pi/2): headings that differ by 180 degrees are equal."""
    return (angle + 0.5 * math.pi) % math.pi - 0.5 * math.pi


@kernel(error_model="numpy")
def size_evidence(ego: FloatArray, other: FloatArray, noise: NoiseModel) -> FloatArray:
    """(M, N) evidence of the footprints alone, heavy-tailed (Student t, 3 degrees of freedom) in length and width."""
    table = np.zeros((len(ego), len(other)))
    if not noise.use_size:
        return table
    for m in range(len(ego)):
        for n in range(len(other)):
            a = (ego[m, LENGTH] - other[n, LENGTH]) / noise.length_std
            b = (ego[m, WIDTH] - other[n, WIDTH]) / noise.width_std
            table[m, n] = noise.size_gain - 2.0 * math.log((1.0 + 0.25 * a * a) * (1.0 + 0.25 * b * b))
    return table


@kernel(error_model="numpy")
def pair_evidence(
    squared_distance: float, heading_difference: float, position_variance: float, noise: NoiseModel
) -> float:
    """Evidence of one pair's residual, without its sizes.

    Args:
        squared_distance: between the two centres under the hypothetical pose [m^2].
        heading_difference: between the two headings under it [rad].
        position_variance: of each component of that distance if the pair is one object [m^2].
        noise: the noise model.
    """
    position = -math.log(2.0 * math.pi * position_variance * noise.density) - 0.5 * squared_distance / position_variance
    if noise.use_flips:
        h = wrap_half_turn(heading_difference)
        flipped = abs(wrap(heading_difference)) > 0.5 * math.pi
        turn = math.log(2.0 * (noise.flip_probability if flipped else 1.0 - noise.flip_probability))
    else:
        h = wrap(heading_difference)
        turn = math.log(2.0)
    wide = _HEADING_TAIL_WIDTH * noise.heading_std
    same = (1.0 - _HEADING_TAIL_SHARE) * math.exp(-0.5 * (h / noise.heading_std) ** 2) / (noise.heading_std * _SQRT_2PI)
    same += _HEADING_TAIL_SHARE * math.exp(-0.5 * (h / wide) ** 2) / (wide * _SQRT_2PI)
    chance = _ROAD_SHARE * math.exp(-0.5 * (h / _ROAD_STD) ** 2) / (_ROAD_STD * _SQRT_2PI)
    chance += (1.0 - _ROAD_SHARE) / math.pi
    return position + math.log((same + 1e-12) / chance) + turn
