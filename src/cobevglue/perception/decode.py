"""Decoding of the output of the head: top-scoring candidates, non-maximum suppression, box voting, variances."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import torch

from cobevglue.boxes import Boxes
from cobevglue.iou import bev_iou, nms
from cobevglue.perception.anchors import AnchorGrid
from cobevglue.perception.config import DetectionConfig
from cobevglue.perception.head import HeadOutput
from cobevglue.perception.loss import MAX_LOG_VARIANCE, MIN_LOG_VARIANCE
from cobevglue.se2 import wrap_angle
from cobevglue.typing import FloatArray

__all__ = ["LABEL", "Detections", "decode"]

LABEL = "vehicle"
"""The only class."""
_TEMPERATURE = 0.05
"""Of the weight of a box in the vote: exp(-(1 - IoU)^2 / temperature) (He et al., CVPR 2019, equation 12)."""


class Detections(NamedTuple):
    """Detections in one cloud.

    Attributes:
        boxes: K boxes in the LiDAR's frame, by descending score, with score and label.
        variance: (K, 3) predicted variance of x, y [m^2] and yaw [rad^2]; of yaw modulo pi.
        heading_confidence: (K,) in [0, 1], the probability of this heading minus that of the opposite one.
    """

    boxes: Boxes
    variance: FloatArray
    heading_confidence: FloatArray


def decode(output: HeadOutput, anchors: AnchorGrid, config: DetectionConfig) -> list[Detections]:
    """Decode the output of the head for B clouds.

    Args:
        output: of the head.
        anchors: the anchors of the head.
        config: settings.

    Returns:
        The detections of each cloud.
    """
    return [_decode_one(HeadOutput(*(v[b] for v in output)), anchors, config) for b in range(len(output.logits))]


def _decode_one(output: HeadOutput, anchors: AnchorGrid, config: DetectionConfig) -> Detections:
    count = min(config.candidates, len(output.logits))
    logits, index = output.logits.float().topk(count)
    kept = torch.sigmoid(logits) >= config.score_threshold
    logits, index = logits[kept], index[kept]

    def selected(values: torch.Tensor) -> FloatArray:
        return values[index].double().cpu().numpy()

    direction = selected(output.direction)
    values = anchors.decode(selected(output.residuals), direction.argmax(axis=1), index.cpu().numpy())
    variance = np.exp(np.clip(selected(output.log_variance), MIN_LOG_VARIANCE, MAX_LOG_VARIANCE))
    score = torch.sigmoid(logits).double().cpu().numpy()
    candidates = Boxes(values[:, :3], values[:, 3:6], values[:, 6], score, label=np.full(len(values), LABEL))

    deviation = np.sqrt(variance[:, :2].sum(axis=1))
    ranked = candidates.replace(score=score * np.exp(-config.uncertainty_penalty * deviation))
    rows = nms(ranked, config.nms_iou)[: config.max_detections]
    heading_confidence = np.tanh(np.abs(direction[:, 1] - direction[:, 0]) / 2)  # difference of the two probabilities
    boxes = candidates[rows]
    if config.variance_voting and len(boxes):
        boxes, voted_confidence = _vote(boxes, candidates, variance, heading_confidence, config.voting_iou)
        return Detections(boxes, variance[rows], voted_confidence)
    return Detections(boxes, variance[rows], heading_confidence[rows])


def _vote(
    boxes: Boxes, candidates: Boxes, variance: FloatArray, heading_confidence: FloatArray, min_iou: float
) -> tuple[Boxes, FloatArray]:
    """Weighted average of the candidates that overlap each of K boxes, and (K,) heading confidence.

    Args:
        boxes: after non-maximum suppression.
        candidates: C boxes before it, with scores.
        variance: (C, 3) of the candidates.
        heading_confidence: (C,) confidence of the direction of the heading, in [0, 1].
        min_iou: candidates with a smaller IoU have no weight.
    """
    iou = bev_iou(boxes, candidates)
    vote = np.where(iou >= min_iou, np.exp(-((1.0 - iou) ** 2) / _TEMPERATURE), 0.0)

    def average(values: FloatArray, weight: FloatArray) -> FloatArray:
        mean: FloatArray = (weight[..., None] * values).sum(axis=1) / weight.sum(axis=1)[:, None]
        return mean

    xy = np.column_stack([average(candidates.center[None, :, i, None], vote / variance[:, i])[:, 0] for i in range(2)])
    turn = candidates.yaw - boxes.yaw[:, None]
    assert candidates.score is not None
    weight = vote * candidates.score
    facing = (weight * heading_confidence * np.cos(turn)).sum(axis=1) / weight.sum(axis=1)
    turn -= math.pi * np.round(turn / math.pi)  # the axis of a flipped candidate is valid
    yaw = wrap_angle(boxes.yaw + average(turn[..., None], vote / variance[:, 2])[:, 0] + math.pi * (facing < 0.0))
    rest = average(np.column_stack([candidates.center[:, 2], candidates.size])[None], vote)
    return boxes.replace(center=np.column_stack([xy, rest[:, 0]]), size=rest[:, 1:], yaw=yaw), np.abs(facing)
