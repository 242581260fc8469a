"""V2VNet made robust to wrong poses (Vadivelu et al., "Learning to Communicate and Correct Pose Errors", CoRL 2020)."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor

from cobevglue.fusion.intermediate import FusionSample
from cobevglue.fusion.pose_matching import PoseMatching
from cobevglue.fusion.v2vnet import V2VNet
from cobevglue.fusion.warp import coverage
from cobevglue.perception import DetectionLoss, PointPillars, TargetBatch
from cobevglue.se2 import SE2
from cobevglue.typing import FloatArray

__all__ = ["V2VNetRobust", "apply_correction", "true_correction"]

_UNIT = np.array([1.0, 1.0, math.radians(2.0)])
"""Errors of x, y [m] and yaw [rad] that are as bad as each other."""


class V2VNetRobust(V2VNet):
    """V2VNet that corrects the relative pose of two agents by their maps, and weighs messages by how well maps fit.

    `correct` is the first; the aligner "v2vnet-robust" asks it about all pairs of agents and makes the answers
    consistent. What is received is fused by the poses it comes with, whoever found them; messages of an agent whose
    map does not fit the ego's there get a small weight.

    It differs from the paper in these points.

    - The networks that correct poses and weigh messages are one here, `PoseMatching`, which compares patches of two
      maps. The paper's are stacks of convolutions of both maps, a mean over all cells and linear layers, which learnt
      nothing in the minutes that a CPU has for them.
    - The training is one stage in place of three. In each sample every second agent has its noisy pose, the others
      have the true one: the paper's strong noise, and none at all for its weak noise of centimetres. Corrections are
      learnt from those poses and once more from the corrected ones, by which the maps are fused; the weights learn how
      far off these poses are. Neither changes the maps.
    - Messages are multiplied with their weights, and the maximum is taken, as in `V2VNet`; the paper has a weighted
      mean.

    Attributes:
        pose_weight: of the corrections in the loss; ours.
        attention_weight: of the messages' weights in the loss; ours.
    """

    usual_aligner = "v2vnet-robust"
    training_noise = (0.4, 4.0)
    pose_weight = 0.2
    attention_weight = 0.2

    def __init__(self, detector: PointPillars) -> None:
        super().__init__(detector)
        self.matching = PoseMatching(self.config, self.channels)

    def fuse_maps(self, maps: Sequence[Tensor], covered: Sequence[Tensor]) -> list[Tensor]:
        """The ego's state after all rounds of weighted messages."""
        others = maps[0][1:]
        _, logits = self.matching(maps[0][:1], others, covered[0][1:], others.new_zeros(len(others), 2))
        return [self._fuse_weighted(maps[0], covered[0], logits)]

    @torch.inference_mode()
    def correct(
        self, features: Sequence[Sequence[Tensor]], believed: Mapping[tuple[int, int], SE2], iterations: int = 3
    ) -> dict[tuple[int, int], tuple[SE2, float]]:
        """Relative poses of pairs of agents, corrected.

        Args:
            features: the encoder's maps (C_i, H_i, W_i) of n agents, each in its own frame.
            believed: first_SE2_second, by the numbers of the two agents.
            iterations: how often each is corrected.

        Returns:
            For each pair its pose, and the share of the first's map that the second's covers.
        """
        maps, _ = self.share([torch.stack(scale) for scale in zip(*features, strict=True)])
        found = {}
        for (first, second), pose in believed.items():
            one, _ = self.placed(maps[first : first + 1], [SE2()], 0)
            other = maps[second : second + 1]
            for _ in range(iterations):
                motions, _ = self._match(one, *self.placed(other, [pose], 0), [pose])
                pose = apply_correction(pose, motions[0].tolist())
            found[first, second] = pose, float(coverage(other, [pose], self.config).mean())
        return found

    def loss(self, samples: Sequence[FusionSample], targets: TargetBatch, loss: DetectionLoss) -> dict[str, Tensor]:
        """The detector's loss, that of the corrections ("pose") and that of the messages' weights ("attention")."""
        agents = [one for sample in samples for one in sample.observations]
        shared = self.share([torch.stack(scale) for scale in zip(*(one.features for one in agents), strict=True)])
        counts = [len(sample.observations) for sample in samples]
        maps, own = (torch.split(m, counts) for m in shared)
        parts = [self._sample_loss(maps[number], sample, number) for number, sample in enumerate(samples)]
        fused, pose, attention = (torch.stack(part) for part in zip(*parts, strict=True))
        terms = loss(self.decode_maps([fused, torch.stack([m[0] for m in own])]), targets)._asdict()
        looks = 2 * max(len(agents) - len(samples), 1)
        terms["pose"], terms["attention"] = pose.sum() / looks, attention.sum() / looks
        terms["total"] = terms["total"] + self.pose_weight * terms["pose"] + self.attention_weight * terms["attention"]
        return terms

    def _sample_loss(self, maps: Tensor, sample: FusionSample, number: int) -> tuple[Tensor, Tensor, Tensor]:
        """The fused map of a sample, and the two losses, summed over both passes over all collaborators."""
        ego, others = self.placed(maps[:1], [SE2()], 0)[0], maps[1:]
        true = sample.true_ego_SE2_agent[1:]
        # Taking turns by the sample's number too, a single collaborator is as often strong as weak.
        noisy = [true[i] if (number + i) % 2 else pose for i, pose in enumerate(sample.ego_SE2_agent[1:])]
        with torch.no_grad():
            moved, reached = self.placed(others, noisy, 0)
        motions, logits = self._match(ego.detach(), moved, reached, noisy)
        pose, attention = _pose_loss(motions, noisy, true), _attention_loss(logits, noisy, true)

        better = [apply_correction(p, motion) for p, motion in zip(noisy, motions.tolist(), strict=True)]
        moved, reached = self.placed(others, better, 0)
        motions, logits = self._match(ego.detach(), moved.detach(), reached, better)
        pose, attention = pose + _pose_loss(motions, better, true), attention + _attention_loss(logits, better, true)
        covered = torch.cat([torch.ones_like(ego[:, :1]), reached])
        return self._fuse_weighted(torch.cat([ego, moved]), covered, logits), pose, attention

    def _match(self, first: Tensor, moved: Tensor, covered: Tensor, poses: Sequence[SE2]) -> tuple[Tensor, Tensor]:
        """The output of `PoseMatching` for P maps that were warped by these poses."""
        middles = moved.new_tensor(np.reshape([_middle(pose).translation for pose in poses], (-1, 2)))
        motions, logits = self.matching(first, moved, covered, middles)
        return motions, logits

    def _fuse_weighted(self, maps: Tensor, covered: Tensor, logits: Tensor) -> Tensor:
        """All rounds of messages; the ego's own have weight 1."""
        weight = torch.cat([logits.new_ones(1), logits.sigmoid()])
        return self.pass_messages(maps, covered * weight[:, None, None, None])


def apply_correction(pose: SE2, motion: Sequence[float]) -> SE2:
    """A relative pose after a correction from the left (section 3.1 of the paper).

    The rotation is about the midpoint between the two agents, where most common objects are: this separates rotation
    and translation, and a small error of the rotation does little harm.

    Args:
        pose: first_SE2_second.
        motion: x, y [m] and yaw [rad], in the first's axes.
    """
    middle = _middle(pose)
    return middle @ SE2(*motion) @ middle.inverse() @ pose


def true_correction(pose: SE2, true: SE2) -> FloatArray:
    """(3,) what `apply_correction` needs to get from `pose` to `true`."""
    middle = _middle(pose)
    motion = middle.inverse() @ true @ pose.inverse() @ middle
    return np.array([motion.x, motion.y, motion.yaw])


def _middle(pose: SE2) -> SE2:
    """The midpoint to the other agent, in the axes of the first."""
    return SE2(pose.x / 2.0, pose.y / 2.0)


def _pose_loss(motions: Tensor, poses: Sequence[SE2], true: Sequence[SE2]) -> Tensor:
    """Smooth L1 of corrections, in units of 1 m and 2 degrees: sum over poses."""
    wanted = [true_correction(p, t) for p, t in zip(poses, true, strict=True)]
    errors = (motions - motions.new_tensor(np.reshape(wanted, (-1, 3)))) / motions.new_tensor(_UNIT)
    return F.smooth_l1_loss(errors, torch.zeros_like(errors), reduction="sum")


def _attention_loss(logits: Tensor, poses: Sequence[SE2], true: Sequence[SE2]) -> Tensor:
    """Cross-entropy with what messages should count, 1 in place and exp(-1/2) at 1 m or 2 degrees: sum over poses."""
    errors = [true_correction(p, t) / _UNIT for p, t in zip(poses, true, strict=True)]
    wanted = np.exp(-0.5 * np.square(np.reshape(errors, (-1, 3))).sum(axis=1))
    return F.binary_cross_entropy_with_logits(logits, logits.new_tensor(wanted), reduction="sum")
