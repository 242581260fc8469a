"""How the map of one agent lies on that of another, found by what is where in both."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cobevglue.perception import PointPillarsConfig

__all__ = ["PoseMatching"]

_LEAST_VARIANCE = 1e-3
"""Of an embedding over a map: an empty map stays finite."""
_CELL_COVERED, _PATCH_COVERED = 0.99, 0.5
"""Shares of a cell and of a patch that have to be covered for them to be compared."""
_NO_MOTION = 0.1
"""How much the wish for no motion counts, in patches that are certain; without it, empty maps would fly off ..."""
_NO_MOTION_AT = 20.0
"""... at this distance from the middle, as far as a turn is concerned [m]."""
_TEMPERATURE = 10.0


class PoseMatching(nn.Module):
    """Estimates the small rigid motion that aligns a second map with the first.

    Every cell is embedded in a few numbers, normalised to zero mean and unit variance over the map. Patches of the
    first map are correlated with the second, at all shifts of a few cells. A softmax over the shifts gives the
    displacement of each patch; the weight of a patch is the peak of the softmax times a learnt weight. The motion fits
    all displacements by weighted least squares. Two layers on the same correlations give the confidence of the motion.

    The untrained module already gives a rough motion, so that a thousand samples are enough for training.

    Args:
        config: the detector's settings, for the range.
        channels: of the maps.
        embedding: numbers that cells are compared by.
        window: largest shift [cells].
        patch: side of a patch [cells].
    """

    def __init__(
        self, config: PointPillarsConfig, channels: int, embedding: int = 16, window: int = 3, patch: int = 4
    ) -> None:
        super().__init__()
        self.config = config
        self.window, self.patch = window, patch
        shifts = (2 * window + 1) ** 2
        self.embedding = nn.Conv2d(channels, embedding, 1, bias=False)
        nn.init.orthogonal_(self.embedding.weight, gain=0.2)  # scaled afterwards: small weights learn faster
        self.log_temperature = nn.Parameter(torch.tensor(math.log(_TEMPERATURE)))
        self.confidence = nn.Sequential(nn.Conv2d(shifts, 32, 1), nn.ReLU(), nn.Conv2d(32, 1, 1))
        self.agreement = nn.Sequential(nn.Conv2d(shifts, 16, 1), nn.ReLU())
        self.trust = nn.Sequential(nn.Linear(16 + 3, 16), nn.ReLU(), nn.Linear(16, 1))

    def forward(self, first: Tensor, second: Tensor, covered: Tensor, middles: Tensor) -> tuple[Tensor, Tensor]:
        """The motions that bring the second of P pairs of maps to their places, and whether they are there already.

        Args:
            first: (1, C, H, W) or (P, C, H, W).
            second: (P, C, H, W), in the frame of the first; 0 where it does not reach.
            covered: (P, 1, H, W) where it does reach.
            middles: (P, 2) points about which motions turn [m].

        Returns:
            (P, 3) x, y [m] and yaw [rad], in the axes of the first, and (P,) logits of being in place.
        """
        correlations, inside = self._correlate(first.expand_as(second), second, covered)
        correlations = correlations * self.log_temperature.exp()
        likely = correlations.softmax(dim=1)
        clear = likely.square().sum(dim=1, keepdim=True) - 1.0 / likely.shape[1]
        weight = clear * inside * self.confidence(correlations).sigmoid()
        shifts, cells = self._in_metres(second)
        moves = -torch.einsum("pshw,sc->pchw", likely, shifts)
        motions, fitted = _motion(moves, cells - middles[:, :, None, None], weight)

        total = weight.sum(dim=(2, 3))

        def mean(values: Tensor) -> Tensor:
            weighted: Tensor = (values * weight).sum(dim=(2, 3)) / (total + _NO_MOTION)
            return weighted

        # Confidence is high if the weights are large, the motion is small, and few displacements disagree with it.
        motion, other_motions = (
            mean(m.square().sum(dim=1, keepdim=True)).detach().sqrt() for m in (fitted, moves - fitted)
        )
        evidence = [mean(self.agreement(correlations)), motion, other_motions, total.detach().log1p()]
        logits: Tensor = self.trust(torch.cat(evidence, dim=1))
        return motions, logits[:, 0]

    def _correlate(self, first: Tensor, second: Tensor, covered: Tensor) -> tuple[Tensor, Tensor]:
        """(P, shifts, h, w) of patches of the first map with the second, and (P, 1, h, w) whether it covers them."""
        one = self._embed(first, torch.ones_like(covered))
        other = F.pad(self._embed(second, covered), [self.window] * 4)
        rows, columns = one.shape[-2:]
        # Less the other's energy, as in a square of differences: a patch shall not be drawn to what is bright.
        likeness = [
            (shifted * (one - 0.5 * shifted)).mean(dim=1)
            for row in range(2 * self.window + 1)
            for column in range(2 * self.window + 1)
            for shifted in [other[..., row : row + rows, column : column + columns]]
        ]
        inside = F.avg_pool2d(covered, self.patch) > _PATCH_COVERED
        return F.avg_pool2d(torch.stack(likeness, dim=1), self.patch), inside

    def _embed(self, maps: Tensor, covered: Tensor) -> Tensor:
        inside = (covered > _CELL_COVERED).to(maps)
        count = inside.sum(dim=(2, 3), keepdim=True).clamp(min=1.0)
        embedded = self.embedding(maps) * inside
        centred = (embedded - embedded.sum(dim=(2, 3), keepdim=True) / count) * inside
        variance = centred.square().sum(dim=(2, 3), keepdim=True) / count
        scaled: Tensor = centred / (variance + _LEAST_VARIANCE).sqrt()
        return scaled

    def _in_metres(self, maps: Tensor) -> tuple[Tensor, Tensor]:
        """(shifts, 2) x and y of each shift, and (2, h, w) of each patch's centre [m]."""
        (x_min, x_max), (y_min, y_max) = self.config.x_range, self.config.y_range
        rows, columns = maps.shape[-2:]
        cell = torch.tensor([(x_max - x_min) / columns, (y_max - y_min) / rows])
        x = x_min + cell[0] * (torch.arange(columns) + 0.5)
        y = y_min + cell[1] * (torch.arange(rows) + 0.5)
        cells = torch.stack([x.expand(rows, columns), y[:, None].expand(rows, columns)])
        steps = torch.arange(-self.window, self.window + 1)
        shifts = torch.stack([steps.repeat(len(steps)), steps.repeat_interleave(len(steps))], dim=1) * cell
        return shifts.to(maps), F.avg_pool2d(cells, self.patch).to(maps)


def _motion(moves: Tensor, at: Tensor, weight: Tensor) -> tuple[Tensor, Tensor]:
    """The small rigid motions that move points as they are to be moved, as far as they can.

    Args:
        moves: (P, 2, h, w) of points [m].
        at: (P, 2, h, w) where they are, with the point in the origin that the motion turns about [m].
        weight: (P, 1, h, w) what each counts.

    Returns:
        (P, 3) x, y [m] and yaw [rad], and (P, 2, h, w) how these move the points [m].
    """
    x, y = at[:, 0], at[:, 1]
    one, zero = torch.ones_like(x), torch.zeros_like(x)
    # A small turn moves (x, y) by yaw * (-y, x).
    design = torch.stack([torch.stack([one, zero, -y], dim=1), torch.stack([zero, one, x], dim=1)], dim=1)
    weighted = design * weight[:, None]
    normal = torch.einsum("pimhw,pinhw->pmn", weighted, design)
    normal = normal + _NO_MOTION * torch.diag(x.new_tensor([1.0, 1.0, _NO_MOTION_AT**2]))
    wanted = torch.einsum("pimhw,pihw->pm", weighted, moves)
    motions = torch.linalg.solve(normal, wanted[..., None])[..., 0]
    return motions, torch.einsum("pimhw,pm->pihw", design, motions)
