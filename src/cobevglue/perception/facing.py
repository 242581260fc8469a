"""Which way a vehicle faces: a second look at the points on every one that was found.

The head knows the axis of a vehicle well and errs in which of its two ends is the front: that is in the slope of a
windscreen or the length of a bonnet, smaller than a pillar, and looks different at every heading. Here the points are
looked at themselves, each vehicle's in its own axes, in which all look alike. So are the vehicles around: traffic in a
lane faces one way. What the head thought counts as well: it sees the road.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from cobevglue.datasets.labelled_cloud import points_at
from cobevglue.perception.decode import Found
from cobevglue.typing import Float32Array

__all__ = ["FacingNet", "Looks", "face", "look_at"]

_POINTS = 64
"""Looked at on each vehicle."""
_MARGIN = 0.3
"""By how much a box is enlarged on every side, for the points of what it missed [m]."""
_BELOW, _ABOVE = 0.1, 0.4
"""The same downwards, where the ground is near, and upwards [m]."""
_VEHICLES = 16
"""The nearest ones are looked at around each."""
_CHANNELS = 64
_NEAR, _FAR = 20.0, 50.0  # metres that count as 1


class Looks(NamedTuple):
    """What there is to see of K found vehicles.

    Attributes:
        points: (K, P, 3) float32 x, y, z [m] from the box's centre, x along its heading; zeros behind the last.
        number: (K,) of points in the box; where there are more than P, P of them are taken.
        vehicle: (K, 9) float32 x, y, z, l, w, h [m], yaw [rad] in the LiDAR's frame, score, and `Found.sure`.
        around: (K, M, 6) float32 of the nearest others: x, y [m] in the vehicle's axes, cosine and sine of their
            heading there, score, and how sure that heading is; zeros behind the last.
    """

    points: Tensor
    number: Tensor
    vehicle: Tensor
    around: Tensor


def look_at(points: Float32Array, found: Found) -> Looks:
    """What there is to see of the vehicles that were found in a cloud.

    Args:
        points: (N, 4) x, y, z [m], intensity, the cloud; rows with NaN lie in no box.
        found: K vehicles in it.
    """
    boxes = found.boxes
    assert boxes.score is not None
    taken = np.zeros((len(boxes), _POINTS, 3), dtype=np.float32)
    number = np.zeros(len(boxes), dtype=np.int64)
    for row, (_, at) in enumerate(points_at(points, boxes, _MARGIN)):
        half = boxes.size[row, 2] / 2.0
        on = at[(at[:, 2] >= -half - _BELOW) & (at[:, 2] <= half + _ABOVE)]
        number[row] = len(on)
        if len(on) > _POINTS:
            on = on[np.arange(_POINTS) * len(on) // _POINTS]
        taken[row, : len(on)] = on
    vehicle = np.column_stack([boxes.center, boxes.size, boxes.yaw, boxes.score, found.sure])
    arrays = taken, number, vehicle.astype(np.float32), _around(found)
    return Looks(*(torch.from_numpy(values) for values in arrays))


def _around(found: Found) -> Float32Array:
    """(K, M, 6), see `Looks`."""
    boxes = found.boxes
    around = np.zeros((len(boxes), _VEHICLES, 6), dtype=np.float32)
    if len(boxes) < 2:
        return around
    assert boxes.score is not None
    gap = boxes.center[None, :, :2] - boxes.center[:, None, :2]
    distance = np.hypot(gap[..., 0], gap[..., 1])
    np.fill_diagonal(distance, np.inf)
    rows = np.argsort(distance, axis=1, kind="stable")[:, : min(_VEHICLES, len(boxes) - 1)]
    gap = np.take_along_axis(gap, rows[..., None], axis=1)
    c, s = np.cos(boxes.yaw)[:, None], np.sin(boxes.yaw)[:, None]
    turn = boxes.yaw[rows] - boxes.yaw[:, None]
    along, across = c * gap[..., 0] + s * gap[..., 1], c * gap[..., 1] - s * gap[..., 0]
    columns = along, across, np.cos(turn), np.sin(turn), boxes.score[rows], found.sure[rows]
    around[:, : rows.shape[1]] = np.stack(columns, axis=-1)
    return around


class FacingNet(nn.Module):
    """Tells front from back: a PointNet (Qi et al., CVPR 2017) that cannot but agree with itself.

    Its answer is g(look) - g(the look turned by 180 degrees), with g a network. So turning a vehicle's box round
    changes the answer's sign and nothing else, and what is learnt of fronts holds for backs. It is told from which side
    and how far away a vehicle is seen, but neither its place nor its heading in the LiDAR's frame. Untrained, it is
    never sure.
    """

    def __init__(self) -> None:
        super().__init__()
        c = _CHANNELS
        self.point = nn.Sequential(nn.Linear(3, c), nn.ReLU(), nn.Linear(c, c), nn.ReLU(), nn.Linear(c, 2 * c))
        self.other = nn.Sequential(nn.Linear(8, c), nn.ReLU(), nn.Linear(c, c), nn.ReLU())
        self.vehicle = nn.Sequential(
            nn.Linear(4 * c + 9, 2 * c), nn.ReLU(), nn.Linear(2 * c, c), nn.ReLU(), nn.Linear(c, 1)
        )
        last = self.vehicle[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    def forward(self, looks: Looks) -> Tensor:
        """(K,) logits that each faces as its box says; negative where it is the other way round."""
        return (self._front(looks, 1.0) - self._front(looks, -1.0)).float()

    def _front(self, looks: Looks, sign: float) -> Tensor:
        """(K,) how much a look, or with -1 the look turned, is like one from a box that faces as the vehicle does."""
        points, number, vehicle, around = looks
        there = torch.arange(points.shape[1], device=points.device) < number[:, None]
        said = self.point(points * points.new_tensor([sign, sign, 1.0]))
        most = said.masked_fill(~there[..., None], -math.inf).amax(dim=1).relu()  # no points: 0

        place, heading, score, sure = torch.split(around, [2, 2, 1, 1], dim=2)
        seen = [sign * place / _NEAR, sign * heading, score, sure, sign * heading * sure]
        others = self.other(torch.cat(seen, dim=2)) * (score > 0.0)

        center, size, yaw, score, sure = torch.split(vehicle, [3, 3, 1, 1, 1], dim=1)
        c, s = sign * yaw.cos(), sign * yaw.sin()
        x, y = center[:, :1], center[:, 1:2]
        distance = torch.hypot(x, y).clamp(min=1e-3)
        from_ahead, from_the_left = -(c * x + s * y) / distance, (s * x - c * y) / distance  # of the sensor
        facts = [size / 3.0, from_ahead, from_the_left, distance / _FAR, torch.log1p(number[:, None].float()) / 3.0]
        facts += [score, 3.0 * sign * sure]
        parts = [most, others.amax(dim=1), others.sum(dim=1) / 4.0, *facts]
        answer: Tensor = self.vehicle(torch.cat(parts, dim=1))
        return answer[:, 0]


@torch.inference_mode()
def face(found: Found, points: Float32Array, net: FacingNet) -> Found:
    """What was found, turned by 180 degrees where a second look says so.

    Args:
        found: K vehicles in a cloud.
        points: (N, 4) x, y, z [m], intensity, the cloud.
        net: in evaluation mode.

    Returns:
        The same vehicles; `sure` of the second look.
    """
    if not len(found.boxes):
        return found
    device = next(net.parameters()).device
    logits = net(Looks(*(t.to(device) for t in look_at(points, found)))).double().cpu().numpy()
    return found._replace(boxes=found.boxes.turned_round(logits < 0.0), sure=np.tanh(np.abs(logits) / 2.0))
