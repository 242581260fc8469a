"""Heading refinement: a second stage that classifies the front and the back of each detected vehicle.

The detection head estimates the axis of a vehicle well but confuses front and back: the difference lies in the slope of
a windscreen or the length of a bonnet, which is smaller than a pillar. This stage classifies the raw points of each
vehicle in the vehicle's own axes, together with the neighbouring vehicles (traffic in a lane has one direction) and
with the direction that the head predicted.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn

from cobevglue.datasets.labelled_cloud import points_at
from cobevglue.perception.decode import Detections
from cobevglue.typing import Float32Array

__all__ = ["HeadingInputs", "HeadingRefiner", "heading_inputs", "refine_headings"]

_POINTS = 64
"""Points sampled on each vehicle."""
_MARGIN = 0.3
"""Enlargement of a box on every side when its points are collected [m]."""
_BELOW, _ABOVE = 0.1, 0.4
"""Enlargement downwards, less because of the ground, and upwards [m]."""
_VEHICLES = 16
"""Number of nearest neighbours that are used for each vehicle."""
_CHANNELS = 64
_NEAR, _FAR = 20.0, 50.0  # scales of distances to neighbours and to the sensor [m]


class HeadingInputs(NamedTuple):
    """Inputs of the `HeadingRefiner` for K detected vehicles.

    Attributes:
        points: (K, P, 3) float32 x, y, z [m] relative to the box centre, x along its heading; zero-padded.
        number: (K,) number of points in the box; P of them are sampled where there are more.
        vehicle: (K, 9) float32 x, y, z, l, w, h [m], yaw [rad] in the LiDAR's frame, score,
            and heading confidence.
        around: (K, M, 6) float32 of the nearest vehicles: x, y [m] in the vehicle's axes, cosine and sine of their
            relative heading, score, heading confidence; zero-padded.
    """

    points: Tensor
    number: Tensor
    vehicle: Tensor
    around: Tensor


def heading_inputs(points: Float32Array, detections: Detections) -> HeadingInputs:
    """Collect the inputs of the `HeadingRefiner` from a cloud and the detections in it.

    Args:
        points: (N, 4) x, y, z [m], intensity, in the LiDAR frame; rows with NaN are ignored.
        detections: K detections in the same frame.
    """
    boxes = detections.boxes
    assert boxes.score is not None
    sampled = np.zeros((len(boxes), _POINTS, 3), dtype=np.float32)
    number = np.zeros(len(boxes), dtype=np.int64)
    for row, (_, at) in enumerate(points_at(points, boxes, _MARGIN)):
        half = boxes.size[row, 2] / 2.0
        on = at[(at[:, 2] >= -half - _BELOW) & (at[:, 2] <= half + _ABOVE)]
        number[row] = len(on)
        if len(on) > _POINTS:
            on = on[np.arange(_POINTS) * len(on) // _POINTS]
        sampled[row, : len(on)] = on
    vehicle = np.column_stack([boxes.center, boxes.size, boxes.yaw, boxes.score, detections.heading_confidence])
    arrays = sampled, number, vehicle.astype(np.float32), _neighbours(detections)
    return HeadingInputs(*(torch.from_numpy(values) for values in arrays))


def _neighbours(detections: Detections) -> Float32Array:
    """(K, M, 6) `around` of `HeadingInputs`."""
    boxes = detections.boxes
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
    columns = along, across, np.cos(turn), np.sin(turn), boxes.score[rows], detections.heading_confidence[rows]
    around[:, : rows.shape[1]] = np.stack(columns, axis=-1)
    return around


class HeadingRefiner(nn.Module):
    """Classifies the direction of a heading: a PointNet (Qi et al., CVPR 2017), antisymmetric under a half turn.

    The logit is g(inputs) - g(inputs rotated by 180 degrees), with g a network, so that rotating a box by 180 degrees
    only changes the sign. The inputs include the viewing direction and the distance, but neither the position nor the
    heading in the LiDAR frame. With initial weights all logits are 0.
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

    def forward(self, inputs: HeadingInputs) -> Tensor:
        """(K,) logits that the heading is correct; negative where the opposite heading is more likely."""
        return (self._front(inputs, 1.0) - self._front(inputs, -1.0)).float()

    def _front(self, inputs: HeadingInputs, sign: float) -> Tensor:
        """(K,) g of the inputs (sign 1) or of the inputs rotated by 180 degrees (sign -1)."""
        points, number, vehicle, around = inputs
        valid = torch.arange(points.shape[1], device=points.device) < number[:, None]
        encoded = self.point(points * points.new_tensor([sign, sign, 1.0]))
        pooled = encoded.masked_fill(~valid[..., None], -math.inf).amax(dim=1).relu()  # no points: 0

        place, heading, score, confidence = torch.split(around, [2, 2, 1, 1], dim=2)
        neighbours = [sign * place / _NEAR, sign * heading, score, confidence, sign * heading * confidence]
        others = self.other(torch.cat(neighbours, dim=2)) * (score > 0.0)

        center, size, yaw, score, confidence = torch.split(vehicle, [3, 3, 1, 1, 1], dim=1)
        c, s = sign * yaw.cos(), sign * yaw.sin()
        x, y = center[:, :1], center[:, 1:2]
        distance = torch.hypot(x, y).clamp(min=1e-3)
        # Direction to the sensor, in the vehicle's axes.
        from_ahead, from_the_left = -(c * x + s * y) / distance, (s * x - c * y) / distance
        scalars = [size / 3.0, from_ahead, from_the_left, distance / _FAR, torch.log1p(number[:, None].float()) / 3.0]
        scalars += [score, 3.0 * sign * confidence]
        parts = [pooled, others.amax(dim=1), others.sum(dim=1) / 4.0, *scalars]
        logits: Tensor = self.vehicle(torch.cat(parts, dim=1))
        return logits[:, 0]


@torch.inference_mode()
def refine_headings(detections: Detections, points: Float32Array, net: HeadingRefiner) -> Detections:
    """Detections with refined headings: rotated by 180 degrees where the refiner's logit is negative.

    Args:
        detections: K detections.
        points: (N, 4) x, y, z [m], intensity, in the LiDAR frame.
        net: in evaluation mode.

    Returns:
        The detections, with the `heading_confidence` of the refiner.
    """
    if not len(detections.boxes):
        return detections
    device = next(net.parameters()).device
    logits = net(HeadingInputs(*(t.to(device) for t in heading_inputs(points, detections)))).double().cpu().numpy()
    return detections._replace(
        boxes=detections.boxes.flip_headings(logits < 0.0), heading_confidence=np.tanh(np.abs(logits) / 2.0)
    )
