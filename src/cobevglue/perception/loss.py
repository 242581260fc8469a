"""Detection loss: focal loss, smooth L1, cross-entropy of the direction, and likelihood of the predicted variance.

Classification and boxes as in SECOND (Yan et al., Sensors 2018), section 3.2; uncertainty as in the first stage of
CoAlign (Lu et al., ICRA 2023).
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
"""Standard deviations are clamped between 1 cm (0.6 degrees) and 7 m, so that they do not dominate the loss."""

_Weight = Annotated[float, Field(ge=0, allow_inf_nan=False)]


class LossConfig(Settings):
    """Weights of the terms of `DetectionLoss`.

    Attributes:
        classification: of the focal loss.
        box: of the smooth L1 loss of the residuals.
        direction: of the cross-entropy of the direction. With SECOND's 0.2, one box in seven is still flipped after
            the number of steps that a CPU can train.
        uncertainty: of the negative log-likelihood of the errors under the predicted variances.
        alpha: weight of the positives in the focal loss.
        gamma: focusing parameter of the focal loss.
        beta: residual at which smooth L1 changes from quadratic to linear.
    """

    classification: _Weight = 1.0
    box: _Weight = 2.0
    direction: _Weight = 1.0
    uncertainty: _Weight = 0.25
    alpha: Annotated[float, Field(gt=0, lt=1)] = 0.25
    gamma: _Weight = 2.0
    beta: Annotated[float, Field(gt=0)] = 1.0 / 9.0


class LossTerms(NamedTuple):
    """Scalar terms of the loss: `total` is the weighted sum to minimise, the others are unweighted, for logging."""

    total: Tensor
    classification: Tensor
    box: Tensor
    direction: Tensor
    uncertainty: Tensor


@dataclass(frozen=True, slots=True, eq=False)
class TargetBatch:
    """The targets of B clouds. Anchors are indexed over the batch: b * N + anchor.

    Attributes:
        positive: (P,) anchors with an assigned object.
        residuals: (P, 7).
        direction: (P,).
        ignored: (I,) anchors that are neither positive nor background.
    """

    positive: Tensor
    residuals: Tensor
    direction: Tensor
    ignored: Tensor

    def to(self, device: torch.device | str, non_blocking: bool = False) -> TargetBatch:
        """Copy to a device."""
        tensors = (self.positive, self.residuals, self.direction, self.ignored)
        return TargetBatch(*(t.to(device, non_blocking=non_blocking) for t in tensors))


def collate_targets(targets: Sequence[Targets], anchors: int) -> TargetBatch:
    """Collate the targets of several clouds into one batch.

    Args:
        targets: of each cloud.
        anchors: N, the number of anchors of a cloud: `len(AnchorGrid(config))`.
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
        """Compute the terms of the loss; finite also without positives."""
        # Half precision is for the convolutions only: exponentials and sums need float32.
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
        # Headings modulo pi; the direction is a separate term (SECOND, equation 6).
        bounded = torch.cat([error[:, :6], error[:, 6:].sin()], dim=1)
        box = F.smooth_l1_loss(bounded, torch.zeros_like(bounded), reduction="sum", beta=w.beta) / number
        direction = (
            F.cross_entropy(output.direction.flatten(0, 1)[positive], targets.direction, reduction="sum") / number
        )
        uncertainty = _negative_log_likelihood(error.detach(), diagonal, log_variance) / number
        total = w.classification * classification + w.box * box + w.direction * direction + w.uncertainty * uncertainty
        return LossTerms(total, classification, box, direction, uncertainty)

    def _focal(self, logits: Tensor, targets: TargetBatch) -> Tensor:
        """Sum of the focal loss over all anchors that are not ignored."""
        w = self.weights
        background = torch.ones_like(logits)
        background[targets.positive] = 0.0
        background[targets.ignored] = 0.0
        negative = background * logits.sigmoid().pow(w.gamma) * F.softplus(logits)
        objects = logits[targets.positive]
        positive = (-objects).sigmoid().pow(w.gamma) * F.softplus(-objects)
        return (1.0 - w.alpha) * negative.sum() + w.alpha * positive.sum()


def _negative_log_likelihood(error: Tensor, diagonal: Tensor, log_variance: Tensor) -> Tensor:
    """Sum of the negative log-likelihood of errors, up to constants; minimal where the variance is the true one.

    x and y [m] are normally distributed. The heading has a von Mises distribution with concentration 1 / variance, the
    analogue on a circle; its error is taken modulo pi, so that flips do not increase the variance.

    Args:
        error: (P, 7) of the residuals, detached, so that the term trains the variances only.
        diagonal: (P,) of the anchors [m].
        log_variance: (P, 3) predicted, of x, y [m^2] and yaw [rad^2].
    """
    log_variance = log_variance.clamp(MIN_LOG_VARIANCE, MAX_LOG_VARIANCE)
    precision = torch.exp(-log_variance)
    position = (error[:, :2] * diagonal[:, None]).square()
    normal = 0.5 * (position * precision[:, :2] + log_variance[:, :2])
    turn = error[:, 6] - math.pi * torch.round(error[:, 6] / math.pi)
    concentration = precision[:, 2]
    # log I0(k) - k cos(turn), in a form that does not overflow.
    von_mises = torch.log(torch.special.i0e(concentration)) + concentration * (1.0 - torch.cos(turn))
    return normal.sum() + von_mises.sum()
