"""V2VNet made robust to wrong poses (Vadivelu et al., "Learning to Communicate and Correct Pose Errors", CoRL 2020)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cobevglue.fusion.intermediate import FusionSample
from cobevglue.fusion.v2vnet import V2VNet
from cobevglue.fusion.warp import coverage
from cobevglue.perception import DetectionLoss, PointPillars, TargetBatch
from cobevglue.se2 import SE2
from cobevglue.typing import FloatArray

__all__ = ["V2VNetRobust", "apply_correction", "true_correction"]

_UNIT = np.array([1.0, 1.0, math.radians(2.0)])
"""Of corrections as the network says them: x, y [m] and yaw [rad] that weigh the same in its loss."""
_COORDINATE_UNIT = 50.0
"""Of the cells' coordinates as the network sees them [m]."""


class V2VNetRobust(V2VNet):
    """V2VNet with two networks beside it: one corrects the relative pose of two agents, one weighs messages.

    Both look at the shared maps of two agents, the second warped to the frame of the first. `correct` is the first's
    doing; the aligner "v2vnet-robust" asks it about all pairs of agents and makes the answers consistent. What is
    received is fused by the poses it comes with, whoever found them; messages of an agent whose map does not fit the
    ego's there get a small weight.

    It differs from the paper in three things. The training is one stage in place of three: in each sample every second
    agent has its noisy pose, the others have the true one (the paper's strong noise, and none for its weak noise of
    centimetres); the pose network learns to undo the noise, the maps are fused by the corrected poses, and the weights
    learn how far off a pose is, before the correction and after it. Messages are multiplied with their weights and the
    maximum is taken, as in `V2VNet`, where the paper has a weighted mean. And the pose network is told the coordinates
    of the cells, without which it could hardly see a turn.

    Attributes:
        pose_weight: of the corrections in the loss; ours.
        attention_weight: of the messages' weights in the loss; ours.
    """

    usual_aligner = "v2vnet-robust"
    training_noise = (0.4, 4.0)
    pose_weight = 0.5
    attention_weight = 0.5

    def __init__(self, detector: PointPillars) -> None:
        super().__init__(detector)
        channels = 2 * self.config.shrink_channels
        self.correction = _pair_network(2 * channels + 2, channels, outputs=3)
        self.attention = _pair_network(2 * channels, self.config.shrink_channels, outputs=1)

    def fuse_maps(self, maps: Sequence[Tensor], covered: Sequence[Tensor]) -> list[Tensor]:
        """The ego's state after all rounds of weighted messages."""
        return [self._fuse_weighted(maps[0], covered[0], self._attend(maps[0][:1], maps[0][1:]))]

    @torch.inference_mode()
    def correct(
        self,
        features: Sequence[Sequence[Tensor]],
        believed: Mapping[tuple[int, int], SE2],
        iterations: int = 2,
    ) -> dict[tuple[int, int], tuple[SE2, float]]:
        """Relative poses of pairs of agents, corrected.

        Args:
            features: the encoder's maps (C_i, H_i, W_i) of n agents, each in its own frame.
            believed: first_SE2_second, by the numbers of the two agents.
            iterations: how often each is corrected.

        Returns:
            For each pair its pose, and the share of the first's map that the second's covers.
        """
        (maps,) = self.share([torch.stack(scale) for scale in zip(*features, strict=True)])
        found = {}
        for (first, second), pose in believed.items():
            ego, other = maps[first : first + 1], maps[second : second + 1]
            for _ in range(iterations):
                (steps,) = self._steps(ego, self.placed(other, [pose], 0)[0], [pose]).tolist()
                pose = apply_correction(pose, steps)
            found[first, second] = pose, float(coverage(other, [pose], self.config).mean())
        return found

    def loss(self, samples: Sequence[FusionSample], targets: TargetBatch, loss: DetectionLoss) -> dict[str, Tensor]:
        """The detector's loss, that of the corrections ("pose") and that of the messages' weights ("attention")."""
        agents = [seen for sample in samples for seen in sample.seen]
        (shared,) = self.share([torch.stack(scale) for scale in zip(*(seen.features for seen in agents), strict=True)])
        maps = torch.split(shared, [len(sample.seen) for sample in samples])
        parts = [self._sample_loss(maps[number], sample, number) for number, sample in enumerate(samples)]
        fused, pose, attention = (torch.stack(part) for part in zip(*parts, strict=True))
        terms = loss(self.decode_maps([fused]), targets)._asdict()
        collaborators = max(len(agents) - len(samples), 1)
        terms["pose"], terms["attention"] = pose.sum() / collaborators, attention.sum() / collaborators
        terms["total"] = terms["total"] + self.pose_weight * terms["pose"] + self.attention_weight * terms["attention"]
        return terms

    def _sample_loss(self, maps: Tensor, sample: FusionSample, number: int) -> tuple[Tensor, Tensor, Tensor]:
        """The fused map of a sample, and the sums over the ego's collaborators of the two losses."""
        ego, others = maps[:1], maps[1:]
        true = sample.true_ego_SE2_agent[1:]
        # Taking turns by the sample's number too, a single collaborator is as often strong as weak.
        noisy = [true[i] if (number + i) % 2 else pose for i, pose in enumerate(sample.ego_SE2_agent[1:])]
        moved, _ = self.placed(others, noisy, 0)
        steps = self._steps(ego, moved, noisy)
        wanted = [true_correction(n, t) for n, t in zip(noisy, true, strict=True)]
        pose = F.smooth_l1_loss(steps, steps.new_tensor(np.reshape(wanted, (-1, 3))), reduction="sum")

        better = [apply_correction(n, step) for n, step in zip(noisy, steps.tolist(), strict=True)]
        placed, covered = self.placed(others, better, 0)
        logits = self._attend(ego, placed)
        attention = _attention_loss(self._attend(ego, moved), noisy, true) + _attention_loss(logits, better, true)
        maps, covered = torch.cat([ego, placed]), torch.cat([torch.ones_like(ego[:, :1]), covered])
        return self._fuse_weighted(maps, covered, logits), pose, attention / 2.0

    def _steps(self, first: Tensor, moved: Tensor, poses: Sequence[SE2]) -> Tensor:
        """(P, 3) corrections, as `apply_correction` takes them, of the poses by which P maps were moved."""
        (x_min, x_max), (y_min, y_max) = self.config.x_range, self.config.y_range
        rows, columns = first.shape[-2:]
        x = x_min + (x_max - x_min) / columns * (torch.arange(columns) + 0.5)
        y = y_min + (y_max - y_min) / rows * (torch.arange(rows) + 0.5)
        cells = torch.stack([x.expand(rows, columns), y[:, None].expand(rows, columns)]).to(first)
        middles = first.new_tensor(np.reshape([p.translation / 2.0 for p in poses], (-1, 2)))
        coordinates = (cells - middles[:, :, None, None]) / _COORDINATE_UNIT
        steps: Tensor = self.correction(torch.cat([first.expand_as(moved), moved, coordinates], dim=1))
        return steps

    def _attend(self, first: Tensor, moved: Tensor) -> Tensor:
        """(P,) logits of how much messages from agents with these P maps should count."""
        logits: Tensor = self.attention(torch.cat([first.expand_as(moved), moved], dim=1))
        return logits[:, 0]

    def _fuse_weighted(self, maps: Tensor, covered: Tensor, logits: Tensor) -> Tensor:
        """All rounds of messages; the ego's own have weight 1."""
        weight = torch.cat([logits.new_ones(1), logits.sigmoid()])
        return self.pass_messages(maps, covered * weight[:, None, None, None])


def apply_correction(pose: SE2, steps: Sequence[float]) -> SE2:
    """A relative pose after a correction from the left (section 3.1 of the paper).

    It turns about the middle between the two agents, so that a turn that is slightly wrong moves what both see little.

    Args:
        pose: first_SE2_second.
        steps: of x, y and yaw, in the first's axes, in units of 1 m, 1 m and 2 degrees.
    """
    middle = SE2(*(pose.translation / 2.0))
    return middle @ SE2(*(np.asarray(steps) * _UNIT)) @ middle.inverse() @ pose


def true_correction(pose: SE2, true: SE2) -> FloatArray:
    """(3,) what `apply_correction` needs to get from `pose` to `true`."""
    middle = SE2(*(pose.translation / 2.0))
    change = middle.inverse() @ true @ pose.inverse() @ middle
    steps: FloatArray = np.array([change.x, change.y, change.yaw]) / _UNIT
    return steps


def _attention_loss(logits: Tensor, poses: Sequence[SE2], true: Sequence[SE2]) -> Tensor:
    """Sum of the cross-entropies with what messages should count: 1 in place, exp(-1/2) at an error of `_UNIT`."""
    errors = np.reshape([np.divide(p.error_to(t), _UNIT[1:]) for p, t in zip(poses, true, strict=True)], (-1, 2))
    wanted = logits.new_tensor(np.exp(-0.5 * (errors**2).sum(axis=1)))
    return F.binary_cross_entropy_with_logits(logits, wanted, reduction="sum")


def _pair_network(inputs: int, channels: int, outputs: int) -> nn.Sequential:
    """From two maps in one frame to a few numbers: four convolutions that halve them, the mean, three linear layers."""
    layers: list[nn.Module] = []
    for width in (inputs, channels, channels, channels):
        layers += [nn.Conv2d(width, channels, 3, stride=2, padding=1), nn.LeakyReLU(0.01)]
    layers += [nn.AdaptiveAvgPool2d(1), nn.Flatten()]
    layers += [nn.Linear(channels, channels), nn.ReLU(), nn.Linear(channels, channels), nn.ReLU()]
    return nn.Sequential(*layers, nn.Linear(channels, outputs))
