"""DiscoNet (Li et al., NeurIPS 2021): each cell says whom to listen to, taught by a network that has all points."""

from __future__ import annotations

from collections.abc import Sequence

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cobevglue.fusion.intermediate import FusionSample, MultiScaleFusion, SingleMapFusion
from cobevglue.perception import DetectionLoss, PointPillars, TargetBatch
from cobevglue.perception.backbone import conv_norm

__all__ = ["DiscoNet", "EarlyTeacher", "distillation_loss"]


class EarlyTeacher(MultiScaleFusion):
    """DiscoNet's teacher: the neck and the head on the encoder's maps of all agents' points together.

    It is trained, saved and loaded as any method is, but is none: what is asked for in use it does not have.
    """

    learns_from_merged_clouds = True

    def conditioned_channels(self) -> Sequence[int]:
        """None: all points are in the ego's frame."""
        return []

    def fused(self, samples: Sequence[FusionSample]) -> list[Tensor]:
        """The maps of the merged cloud.

        Raises:
            ValueError: there are none of a sample with several agents.
        """
        features = []
        for number, sample in enumerate(samples):
            maps = merged_features(sample)
            if maps is None:
                raise ValueError(f"samples: {number}: early_features: needed by DiscoNet's teacher, got None")
            features.append(maps)
        return [torch.stack(scale) for scale in zip(*features, strict=True)]

    def fuse_maps(self, maps: Sequence[Tensor], covered: Sequence[Tensor]) -> list[Tensor]:
        """The ego's own map: the merged cloud needs no fusion."""
        return [m[0] for m in maps]

    @torch.no_grad()
    def target(self, samples: Sequence[FusionSample]) -> Tensor:
        """(B, C, H, W) the input of the teacher's head, the target of the student's fused map."""
        target: Tensor = self.neck(self.fused(samples))
        return target


class DiscoNet(SingleMapFusion):
    """Weighted sum of the agents' maps at stride 2, by matrix-valued edge weights (section 3.2 of the paper).

    How much of another's map goes into a cell of the ego's is found by 1 x 1 convolutions of both maps, and a softmax
    over the agents whose maps reach that cell. The paper lets all agents take part everywhere.

    In training a teacher may be given (section 3.3): the fused map shall be like the one that the teacher has before
    its head. The paper also compares the layers after that; ours has none but the head's 1 x 1 convolutions.

    Attributes:
        teacher: what `loss` compares with; None for detection alone. Set it to what is trained already: it is frozen
            and in evaluation mode from then on, and it is no part of this network's weights.
        distillation_weight: of the comparison in the loss; ours.
    """

    teacher: EarlyTeacher | None
    distillation_weight = 10.0
    learns_from_merged_clouds = True

    def __init__(self, detector: PointPillars) -> None:
        super().__init__(detector)
        channels = self.config.shrink_channels
        self.edge = nn.Sequential(
            conv_norm(2 * channels, channels, 1),
            conv_norm(channels, channels // 2, 1),
            conv_norm(channels // 2, 8, 1),
            nn.Conv2d(8, 1, 1, bias=False),  # a softmax over agents follows: what is the same for all does nothing
        )
        self.teacher = None

    def __setattr__(self, name: str, value: object) -> None:
        if name == "teacher":
            if isinstance(value, EarlyTeacher):
                value.eval().requires_grad_(False)
            object.__setattr__(self, name, value)  # torch would make its weights this network's
        else:
            super().__setattr__(name, value)  # type: ignore[arg-type]

    def fuse_maps(self, maps: Sequence[Tensor], covered: Sequence[Tensor]) -> list[Tensor]:
        """The weighted sum over agents."""
        (agents,) = maps
        pairs = torch.cat([agents[:1].expand_as(agents), agents], dim=1)
        logits = self.edge(pairs) + covered[0].log()  # minus infinity where an agent's map does not reach
        return [(logits.softmax(dim=0) * agents).sum(dim=0)]

    def loss(self, samples: Sequence[FusionSample], targets: TargetBatch, loss: DetectionLoss) -> dict[str, Tensor]:
        """The detector's loss and, with a teacher, how far the fused maps are from the teacher's ("distillation").

        Samples of several agents without `early_features` take no part in the comparison.
        """
        (maps,) = self.fused(samples)
        terms = loss(self.decode_maps([maps]), targets)._asdict()
        if self.teacher is not None:
            known = [i for i, sample in enumerate(samples) if merged_features(sample) is not None]
            distillation = maps.new_zeros(())
            if known:
                target = self.teacher.target([samples[i] for i in known])
                distillation = distillation_loss(maps[known], target)
            terms["total"] = terms["total"] + self.distillation_weight * distillation
            terms["distillation"] = distillation
        return terms


def merged_features(sample: FusionSample) -> tuple[Tensor, Tensor, Tensor] | None:
    """The encoder's maps of the points of all agents together, where they are known."""
    # With a single agent, the merged cloud is its own.
    return sample.observations[0].features if len(sample.observations) == 1 else sample.early_features


def distillation_loss(student: Tensor, teacher: Tensor) -> Tensor:
    """Equation (5) of DiscoNet: divergence between softmaxes over channels, KL(teacher || student), mean over cells.

    Args:
        student: (B, C, H, W).
        teacher: (B, C, H, W).
    """
    divergence = F.kl_div(student.log_softmax(dim=1), teacher.log_softmax(dim=1), reduction="none", log_target=True)
    return divergence.sum(dim=1).mean()
