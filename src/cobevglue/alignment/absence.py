"""Objects that one agent reports within the view of the other and the other does not (numba kernels).

Under a right pose, most objects that lie amid the boxes of an agent have a counterpart among them; under a wrong pose
they are matched by chance alone. The view of an agent is a disc about the centre of its boxes, so that it does not
matter where the origin of its frame is.
"""

from __future__ import annotations

import math

import numpy as np

from cobevglue._kernels import kernel
from cobevglue.alignment.evidence import X, Y
from cobevglue.alignment.pose_search import place_box

__all__ = ["missing_counterparts"]

_VIEW = 2.0
"""Squared radius of a view, in mean squared distances of the boxes from their centre."""
_LEAST_RADIUS = 5.0
"""Boxes count as spread at least this much [m]."""


@kernel(error_model="numpy")
def _view(boxes):
    """Centre x, y and squared radius of the view that boxes (N, >= 5) show."""
    x = y = squared = 0.0
    for n in range(len(boxes)):
        x += boxes[n, X] / len(boxes)
        y += boxes[n, Y] / len(boxes)
    for n in range(len(boxes)):
        squared += ((boxes[n, X] - x) ** 2 + (boxes[n, Y] - y) ** 2) / len(boxes)
    return x, y, _VIEW * (squared + _LEAST_RADIUS**2)


@kernel(error_model="numpy")
def missing_counterparts(ego, other, star, pairs) -> int:
    """Number of boxes of both lists that lie in the other list's view and are not matched.

    Args:
        ego: (M, 5) boxes, at least one.
        other: (N, 7) boxes with velocity, at least one.
        star: a `STAR` record.
        pairs: (>= star.pairs, 2) its pairs.
    """
    ego_matched, other_matched = np.zeros(len(ego), np.bool_), np.zeros(len(other), np.bool_)
    for k in range(star.pairs):
        ego_matched[pairs[k, 0]] = True
        other_matched[pairs[k, 1]] = True
    cos, sin = math.cos(star.yaw), math.sin(star.yaw)
    missing = 0
    view_x, view_y, squared = _view(ego)
    for n in range(len(other)):
        if not other_matched[n]:
            _, _, x, y = place_box(star, cos, sin, other[n])
            missing += (x - view_x) ** 2 + (y - view_y) ** 2 < squared
    view_x, view_y, squared = _view(other)
    for m in range(len(ego)):
        if not ego_matched[m]:
            dx, dy = ego[m, X] - star.ego_x, ego[m, Y] - star.ego_y
            x, y = star.other_x + cos * dx + sin * dy, star.other_y - sin * dx + cos * dy
            missing += (x - view_x) ** 2 + (y - view_y) ** 2 < squared
    return missing
