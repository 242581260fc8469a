"""Base classes of the methods that share feature maps.

The single-agent encoder is frozen; fusion, neck and head are trained for each method.

The three maps of each agent's backbone are converted to the shared maps (`share`), warped to the ego frame, fused
(`fuse_maps`) and decoded (`decode_maps`). A method consists of these three functions.
"""

from __future__ import annotations

import copy
import json
from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor, nn

from cobevglue.boxes import Boxes
from cobevglue.fusion.method import FusionMethod, Received
from cobevglue.fusion.rotation_conditioning import RotationConditioning
from cobevglue.fusion.warp import coverage, warp
from cobevglue.messages import Arrays
from cobevglue.perception import DetectionLoss, PerceptionOutput, PointPillars, TargetBatch
from cobevglue.perception.checkpoint import fingerprint, load_checkpoint, load_weights, save_checkpoint
from cobevglue.perception.decode import Detections, decode
from cobevglue.perception.head import HeadOutput
from cobevglue.se2 import SE2

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["FusionSample", "IntermediateFusion", "MultiScaleFusion", "SingleMapFusion", "pooled"]

_LARGEST = 65504.0  # of float16


@dataclass(frozen=True, slots=True, eq=False)
class FusionSample:
    """A training sample: one frame of some agents, the ego first.

    Attributes:
        observations: of the n agents, each in its own LiDAR frame.
        ego_SE2_agent: n estimated poses in the ego frame; the first is the identity.
        true_ego_SE2_agent: the true poses.
        early_features: the three maps of the encoder for the merged cloud of all agents (by the true poses), for
            DiscoNet's teacher; None where they are unknown.
        truth: the ground-truth objects, in the ego's LiDAR frame.
    """

    observations: Sequence[PerceptionOutput]
    ego_SE2_agent: Sequence[SE2]
    true_ego_SE2_agent: Sequence[SE2]
    early_features: tuple[Tensor, Tensor, Tensor] | None = None
    truth: Boxes | None = None


class IntermediateFusion(FusionMethod, nn.Module):
    """Shares feature maps. The neck and the head start as the detector's and are trained with the fusion.

    Args:
        detector: whose features are shared; it is not changed.

    Attributes:
        config: the detector's settings.
        detection: how boxes are chosen, the detector's own settings at first.
        training_noise: standard deviation of x and y [m] and yaw [degrees] of every agent's pose in training, as the
            method's paper has it.
        learns_from_merged_clouds: whether `loss` uses `FusionSample.early_features`.
        shares_maps: whether a message is whole maps, of which a compressed one may have some cells only.
    """

    training_noise: ClassVar[tuple[float, float]] = (0.0, 0.0)
    learns_from_merged_clouds: ClassVar[bool] = False
    shares_maps: ClassVar[bool] = True

    def __init__(self, detector: PointPillars) -> None:
        nn.Module.__init__(self)
        self.config = detector.config
        self.detection = detector.detection
        self.anchors = detector.anchors
        self.neck = copy.deepcopy(detector.neck)
        self.head = copy.deepcopy(detector.head)
        self.conditioning = nn.ModuleList(RotationConditioning(channels) for channels in self.conditioned_channels())
        self.metadata: dict[str, Any] = {}
        self.encoder = fingerprint(nn.ModuleList([detector.pillars, detector.backbone]))

    @abstractmethod
    def conditioned_channels(self) -> Sequence[int]:
        """Channels of the shared maps that are rotation-conditioned, the first ones of `share`."""

    @abstractmethod
    def share(self, features: Sequence[Tensor]) -> list[Tensor]:
        """From the encoder's maps of B agents, (B, C_i, H_i, W_i) at strides 2, 4, 8, to the transmitted maps."""

    @abstractmethod
    def fuse_maps(self, maps: Sequence[Tensor], covered: Sequence[Tensor]) -> list[Tensor]:
        """Fuse the maps of n agents.

        Args:
            maps: each (n, C, H, W), warped to the ego's frame, the ego first; 0 outside an agent's coverage.
            covered: (n, 1, H, W) coverage of each map: 1 inside, 0 outside.

        Returns:
            Maps (C, H, W), as `decode_maps` takes them.
        """

    @abstractmethod
    def decode_maps(self, maps: Sequence[Tensor]) -> HeadOutput:
        """From fused maps of B egos, each (B, C, H, W), to the predictions per anchor."""

    def forward(self, samples: Sequence[FusionSample]) -> HeadOutput:
        """Predictions per anchor in the ego frame of each of B samples."""
        return self.decode_maps(self.fused(samples))

    def fused(self, samples: Sequence[FusionSample]) -> list[Tensor]:
        """The fused maps, each (B, C, H, W), of B samples."""
        agents = [one for sample in samples for one in sample.observations]
        features = [torch.stack(scale) for scale in zip(*(one.features for one in agents), strict=True)]
        shared = self.share(features)
        counts = [len(sample.observations) for sample in samples]
        fused = [
            self._fuse(maps, sample.ego_SE2_agent)
            for sample, maps in zip(samples, zip(*(torch.split(m, counts) for m in shared), strict=True), strict=True)
        ]
        return [torch.stack(scale) for scale in zip(*fused, strict=True)]

    def _fuse(
        self, maps: Sequence[Tensor], ego_SE2_agent: Sequence[SE2], sent: Sequence[Tensor] | None = None
    ) -> list[Tensor]:
        """Warp and fuse maps (n, C, H, W) of n agents, the ego first; `sent`: of each map as `placed` has it."""
        placed = [self.placed(m, ego_SE2_agent, i, None if sent is None else sent[i]) for i, m in enumerate(maps)]
        return self.fuse_maps([m for m, _ in placed], [covered for _, covered in placed])

    def placed(
        self, maps: Tensor, ego_SE2_agent: Sequence[SE2], index: int, sent: Tensor | None = None
    ) -> tuple[Tensor, Tensor]:
        """Maps of agents, warped to the ego frame and rotation-conditioned.

        Args:
            maps: (B, C, H, W) shared maps of B agents.
            ego_SE2_agent: B poses, the ego's own may be among them.
            index: of the shared map.
            sent: (B, 1, H, W) 1 in the cells that were sent, 0 in others; None where all were.

        Returns:
            (B, C, H, W), and their coverage of each cell, (B, 1, H, W).
        """
        warped = warp(maps, ego_SE2_agent, self.config)
        covered = coverage(maps, ego_SE2_agent, self.config) if sent is None else warp(sent, ego_SE2_agent, self.config)
        if index < len(self.conditioning):
            warped = self.conditioning[index](warped, [pose.yaw for pose in ego_SE2_agent], covered)
        return warped, covered

    def loss(self, samples: Sequence[FusionSample], targets: TargetBatch, loss: DetectionLoss) -> dict[str, Tensor]:
        """The training loss ("total") and its parts for the log.

        Args:
            samples: B frames.
            targets: of every anchor in each ego frame.
            loss: the detector's loss function.
        """
        return loss(self(samples), targets)._asdict()

    @torch.inference_mode()
    def message(self, observation: PerceptionOutput) -> Arrays:
        """The shared maps (C, H, W) in float16."""
        shared = self.share([m[None] for m in observation.features])
        return {f"map{i}": _half(m[0]) for i, m in enumerate(shared)}

    def received_maps(self, content: Arrays) -> list[Tensor]:
        """The maps (C, H, W) of a message."""
        count = sum(name.startswith("map") for name in content)
        return [torch.from_numpy(content[f"map{i}"].astype(np.float32)) for i in range(count)]

    @torch.inference_mode()
    def confidence(self, observation: PerceptionOutput) -> Tensor:
        """(1, 1, H, W) the best score of any anchor in each cell at stride 2, from the agent's own maps."""
        own = self.share([m[None] for m in observation.features])
        output = self.decode_maps([m[None] for m in self._fuse(own, [SE2()])])
        return output.logits.view(1, *self.config.head_shape).amax(dim=-1)[:, None].sigmoid()

    @torch.inference_mode()
    def fuse(self, ego: PerceptionOutput, received: Sequence[Received]) -> Boxes:
        """The boxes decoded from the fused maps."""
        own = self.share([m[None] for m in ego.features])
        others = [self.received_maps(other.content) for other in received]
        maps = [torch.cat([m, *(o[i][None].to(m) for o in others)]) for i, m in enumerate(own)]
        poses = [SE2(), *(other.ego_SE2_other for other in received)]
        fused = self._fuse(maps, poses, _sent(own, [other.content for other in received]))
        (found,) = self.boxes(self.decode_maps([m[None] for m in fused]))
        return found.boxes

    def boxes(self, output: HeadOutput) -> list[Detections]:
        """The detections of each ego, best first."""
        return decode(output, self.anchors, self.detection)

    def save(self, path: str | Path, metadata: Mapping[str, Any] | None = None, half: bool = False) -> None:
        """Write the weights and what is known of them (as JSON can hold it) to one safetensors file.

        Args:
            path: where to; the file appears complete or not at all.
            metadata: data, metrics, seed; the encoder's fingerprint is added.
            half: in float16, for half the size.
        """
        config = json.loads(self.config.model_dump_json())
        known = {**self.metadata, **(metadata or {}), "encoder": self.encoder}
        save_checkpoint(path, self.architecture(), config, self, known, half)

    def load(self, path: str | Path) -> Self:
        """Load weights that `save` wrote, and switch to evaluation mode.

        Raises:
            FileNotFoundError: there is no such file.
            ValueError: the file is damaged, of another method, or for another detector.
        """
        checkpoint = load_checkpoint(path, self.architecture())
        own = json.loads(self.config.model_dump_json(exclude={"detection"}))
        differing = [name for name, value in own.items() if checkpoint.config.get(name) != value]
        if differing:
            raise ValueError(f"{path}: for a detector with other settings: {', '.join(differing)}")
        if checkpoint.metadata.get("encoder") != self.encoder:
            raise ValueError(f"{path}: was trained on the features of another encoder")
        load_weights(self, checkpoint.weights, path)
        self.metadata = checkpoint.metadata
        return self.eval()

    @classmethod
    def architecture(cls) -> str:
        """The name of this method in weights files."""
        return f"fusion {cls.__name__}"


class MultiScaleFusion(IntermediateFusion):
    """Shares the encoder's three maps as they are, fuses each, and decodes them as the detector does."""

    def conditioned_channels(self) -> Sequence[int]:
        """Of the three maps."""
        return self.config.block_channels

    def share(self, features: Sequence[Tensor]) -> list[Tensor]:
        """The maps themselves."""
        return list(features)

    def decode_maps(self, maps: Sequence[Tensor]) -> HeadOutput:
        """The neck and the head."""
        output: HeadOutput = self.head(self.neck(maps))
        return output


class SingleMapFusion(IntermediateFusion):
    """Shares the one map at stride 2 that the neck makes of the three."""

    def conditioned_channels(self) -> Sequence[int]:
        """Of the one map."""
        return [self.config.shrink_channels]

    def share(self, features: Sequence[Tensor]) -> list[Tensor]:
        """The neck's map."""
        return [self.neck(features)]

    def decode_maps(self, maps: Sequence[Tensor]) -> HeadOutput:
        """The head."""
        output: HeadOutput = self.head(maps[0])
        return output


def pooled(mask: Tensor, shape: Sequence[int]) -> Tensor:
    """(n, H, W) of a coarser map of this shape: the maximum over the cells of `mask`, (n, rows, columns), in each."""
    return F.adaptive_max_pool2d(mask, list(shape))


def _sent(own: Sequence[Tensor], messages: Sequence[Arrays]) -> list[Tensor] | None:
    """Of each map (n, 1, H, W) 1 in the cells that were sent, the ego's first; None where all messages are whole."""
    if not any("sent" in content for content in messages):
        return None
    sent = []
    for m in own:
        ones = torch.ones_like(m[:, 0])
        masks = [pooled(ones.new_tensor(c["sent"])[None], m.shape[2:]) if "sent" in c else ones for c in messages]
        sent.append(torch.stack([ones, *masks]))
    return sent


def _half(values: Tensor) -> NDArray[np.float16]:
    rounded: NDArray[np.float16] = values.clamp(-_LARGEST, _LARGEST).to("cpu", torch.float16).numpy()
    return rounded
