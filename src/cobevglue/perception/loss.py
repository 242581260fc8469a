"""What the detector learns from: focal loss, smooth L1, direction, and how far off it expects to be.

Classes and boxes as in SECOND (Yan et al., Sensors 2018), section 3.2; the uncertainty as in the first stage of CoAlign
(Lu et al., ICRA 2023).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from pydantic import Field
from torch import Tensor

from cobevglue.perception.anchors import AnchorGrid, Targets
from cobevglue.perception.config import PointPillarsConfig
from cobevglue.perception.head import HeadOutput
from cobevglue.settings import Settings

__all__ = [
    "MAX_LOG_VARIANCE",
    "MIN_LOG_VARIANCE",
    "DetectionLoss",
    "LossConfig",
    "LossTerms",
    "TargetBatch",
    "collate_targets",
]

MIN_LOG_VARIANCE, MAX_LOG_VARIANCE = -9.0, 4.0
"""Standard deviations are kept between 1 cm (0.6 degrees) and 7 m: outside, the loss would be all about them."""

_Weight = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class LossConfig(Settings):
    """Weights of the terms of `DetectionLoss`.

    Attributes:
        classification: of the focal loss.
        box: of the smooth L1 loss of the residuals.
        direction: of the cross-entropy of the direction; SECOND has 0.2, with which one box in seven stays flipped
            in as few steps as a CPU can do.
        uncertainty: of the negative log-likelihood of the errors under the predicted variances.
        alpha: share of the positives in the focal loss.
        gamma: how little anchors count that are right already.
        beta: residual where smooth L1 turns from square to linear.
    """

    classification: _Weight = 1.0
    box: _Weight = 2.0
    direction: _Weight = 1.0
    uncertainty: _Weight = 0.25
    alpha: Annotated[float, Field(gt=0, lt=1)] = 0.25
    gamma: _Weight = 2.0
    beta: Annotated[float, Field(gt=0)] = 1.0 / 9.0


class LossTerms(NamedTuple):
    """Scalars. `total` is the weighted sum to minimise; the others are without their weights, to be logged."""

    total: Tensor
    classification: Tensor
    box: Tensor
    direction: Tensor
    uncertainty: Tensor


@dataclass(frozen=True, slots=True, eq=False)
class TargetBatch:
    """The targets of B clouds. Anchors are numbered through: b * N + anchor.

    Attributes:
        positive: (P,) anchors that are to find an object.
        residuals: (P, 7).
        direction: (P,).
        ignored: (I,) anchors that count for neither.
    """

    positive: Tensor
    residuals: Tensor
    direction: Tensor
    ignored: Tensor

    def to(self, device: torch.device | str, non_blocking: bool = False) -> TargetBatch:
        """The same on another device."""
        tensors = (self.positive, self.residuals, self.direction, self.ignored)
        return TargetBatch(*(t.to(device, non_blocking=non_blocking) for t in tensors))


def collate_targets(targets: Sequence[Targets], anchors: int) -> TargetBatch:
    """The targets of several clouds as one batch.

    Args:
        targets: of each cloud.
        anchors: N, how many anchors a cloud has: `len(AnchorGrid(config))`.
    """

    def joined(parts: Sequence[object]) -> Tensor:
        return torch.from_numpy(np.concatenate(parts))  # type: ignore[arg-type]

    return TargetBatch(
        joined([b * anchors + t.positive for b, t in enumerate(targets)]),
        joined([t.residuals for t in targets]),
        joined([t.direction for t in targets]),
        joined([b * anchors + t.ignored for b, t in enumerate(targets)]),
    )


class DetectionLoss:
    """The loss of a batch, each term a sum divided by the number of positives in the batch.

    Args:
        config: the detector's settings.
        weights: of the terms.
    """

    def __init__(self, config: PointPillarsConfig, weights: LossConfig | None = None) -> None:
        self.weights = weights or LossConfig()
        self._diagonal = torch.tensor(AnchorGrid(config).diagonal, dtype=torch.float32)

    def __call__(self, output: HeadOutput, targets: TargetBatch) -> LossTerms:
        """How far `output` is from `targets`; finite also where there is nothing to find."""
        # Half precision is for the convolutions: exponentials and sums are not safe in it.
        with torch.autocast(output.logits.device.type, enabled=False):
            return self._terms(HeadOutput(*(values.float() for values in output)), targets)

    def _terms(self, output: HeadOutput, targets: TargetBatch) -> LossTerms:
        w, positive = self.weights, targets.positive
        number = max(len(positive), 1)
        diagonal = self._diagonal.to(positive.device)[positive % len(self._diagonal)]
        residuals = output.residuals.flatten(0, 1)[positive]
        log_variance = output.log_variance.flatten(0, 1)[positive]

        classification = self._focal(output.logits.flatten(), targets) / number
        error = residuals - targets.residuals
        # Headings modulo pi; the direction has the rest (SECOND, equation 6).
        bounded = torch.cat([error[:, :6], error[:, 6:].sin()], dim=1)
        box = F.smooth_l1_loss(bounded, torch.zeros_like(bounded), reduction="sum", beta=w.beta) / number
        direction = (
            F.cross_entropy(output.direction.flatten(0, 1)[positive], targets.direction, reduction="sum") / number
        )
        uncertainty = _negative_log_likelihood(error.detach(), diagonal, log_variance) / number
        total = w.classification * classification + w.box * box + w.direction * direction + w.uncertainty * uncertainty
        return LossTerms(total, classification, box, direction, uncertainty)

    def _focal(self, logits: Tensor, targets: TargetBatch) -> Tensor:
        """Sum of the focal loss over all anchors but the ignored. Nearly all are background."""
        w = self.weights
        background = torch.ones_like(logits)
        background[targets.positive] = 0.0
        background[targets.ignored] = 0.0
        negative = background * logits.sigmoid().pow(w.gamma) * F.softplus(logits)
        found = logits[targets.positive]
        positive = (-found).sigmoid().pow(w.gamma) * F.softplus(-found)
        return (1.0 - w.alpha) * negative.sum() + w.alpha * positive.sum()


def _negative_log_likelihood(error: Tensor, diagonal: Tensor, log_variance: Tensor) -> Tensor:
    """Sum of the negative log-likelihood of errors, up to constants: it is least where the variance is the true one.

    x and y [m] are normal. The heading follows von Mises' distribution with concentration 1 / variance, which is the
    normal one on a circle; headings differ modulo pi here, a flipped box is no uncertain one.

    Args:
        error: (P, 7) of the residuals, detached: being wrong shall not pay.
        diagonal: (P,) of the anchors [m].
        log_variance: (P, 3) predicted, of x, y [m^2] and yaw [rad^2].
    """
    log_variance = log_variance.clamp(MIN_LOG_VARIANCE, MAX_LOG_VARIANCE)
    precision = torch.exp(-log_variance)
    position = (error[:, :2] * diagonal[:, None]).square()
    normal = 0.5 * (position * precision[:, :2] + log_variance[:, :2])
    turn = error[:, 6] - math.pi * torch.round(error[:, 6] / math.pi)
    concentration = precision[:, 2]
    # log I0(k) - k cos(turn), written so that neither overflows.
    von_mises = torch.log(torch.special.i0e(concentration)) + concentration * (1.0 - torch.cos(turn))
    return normal.sum() + von_mises.sum()
