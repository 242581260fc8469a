"""FPV-RCNN (Yuan et al., RA-L 2022): agents share proposals and keypoints with features.

With these, the ego refines the proposals of all agents in a second stage. The paper is "Keypoints-Based Deep Feature
Fusion for Cooperative Vehicle Detection of Autonomous Driving".

On this project's encoder: the paper's is sparse convolutions with a head of their own, and a keypoint's features there
are gathered from their voxels. The paper's correction of localisation errors is the aligner "fpv-rcnn".
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from cobevglue.boxes import Boxes
from cobevglue.fusion.fpv_rcnn_keypoints import select_keypoints
from cobevglue.fusion.fpv_rcnn_proposals import decode_refinement, encode_refinement, merge_proposals
from cobevglue.fusion.fpv_rcnn_roi import RoIHead
from cobevglue.fusion.intermediate import FusionSample, SingleMapFusion, _half
from cobevglue.fusion.method import Received
from cobevglue.iou import bev_iou, nms
from cobevglue.messages import Arrays
from cobevglue.perception import DetectionLoss, PerceptionOutput, PointPillars, TargetBatch
from cobevglue.perception.decode import LABEL, decode
from cobevglue.perception.head import HeadOutput
from cobevglue.se2 import SE2
from cobevglue.typing import Float32Array, IntArray

__all__ = ["FPVRCNN"]

_KEYPOINTS = 1024
"""Maximum number for an agent; the paper has 2048 before those outside proposals are dropped."""
_FEATURES = 32
"""Channels of a keypoint; the smallest number in the paper, with hardly a loss."""
_MARGIN = 0.3
"""Enlargement of proposals on every side when their points are collected [m]."""
_SAME_OBJECT = 0.15
"""Minimum IoU of two agents' proposals of one object: that of non-maximum suppression."""
_RIGHT = 0.3
"""Minimum IoU with an object for a proposal to be regressed to it. With pose errors few overlap by more."""


@dataclass(frozen=True, slots=True, eq=False)
class _Message:
    """The message of one agent: proposals with scores, (K, 3) keypoints [m] in the same frame, (K, F) features.

    `heading` is the agent's own in that frame [rad]: features encode directions relative to it.
    """

    proposals: Boxes
    keypoints: Float32Array
    features: Tensor
    heading: float = 0.0

    def transform(self, ego_SE2_other: SE2) -> _Message:
        return replace(
            self,
            proposals=self.proposals.transform(ego_SE2_other),
            keypoints=ego_SE2_other.apply(self.keypoints).astype(np.float32),
            heading=self.heading + ego_SE2_other.yaw,
        )


class FPVRCNN(SingleMapFusion):
    """A two-stage detector. The first stage is single-agent: each agent's detections are its proposals.

    In the second, the proposals of all agents are merged; each is scored and refined from the keypoints in it. A
    message has up to `detection.max_detections` proposals of 32 bytes and 1024 keypoints of 76.

    Attributes:
        proposal_score: minimum score of a proposal.
    """

    usual_aligner = "fpv-rcnn"
    shares_maps = False
    proposal_score: float = 0.1

    def __init__(self, detector: PointPillars) -> None:
        super().__init__(detector)
        self.describe = nn.Linear(self.config.shrink_channels, _FEATURES)
        self.second_stage = RoIHead(_FEATURES, _MARGIN)

    def conditioned_channels(self) -> Sequence[int]:
        """None: no maps are shared, and the second stage is rotation-conditioned itself."""
        return []

    def fuse_maps(self, maps: Sequence[Tensor], covered: Sequence[Tensor]) -> list[Tensor]:
        """The ego's own map: the first stage is not fused."""
        return [maps[0][0]]

    @torch.inference_mode()
    def message(self, observation: PerceptionOutput) -> Arrays:
        """Proposals and keypoints in the sender's LiDAR frame, and the keypoints' features.

        (P, 8) float32 x, y, z, l, w, h [m], yaw [rad], score; (K, 3) float32 x, y, z [m]; (K, F) float16.
        """
        own = self._own_message(observation)
        assert own.proposals.score is not None
        proposals = np.column_stack([_rows(own.proposals), own.proposals.score]).astype(np.float32)
        return {"proposals": proposals, "keypoints": own.keypoints, "features": _half(own.features)}

    @torch.inference_mode()
    def fuse(self, ego: PerceptionOutput, received: Sequence[Received]) -> Boxes:
        """The merged proposals after the second stage, best first."""
        messages = [self._own_message(ego), *(self._decode(other) for other in received)]
        proposals, _, logits, refinement = self._second_stage(messages)
        boxes = decode_refinement(refinement.double().cpu().numpy(), proposals)
        boxes = boxes.replace(score=logits.sigmoid().double().cpu().numpy(), label=np.full(len(boxes), LABEL))
        assert boxes.score is not None
        boxes = boxes[boxes.score >= self.detection.score_threshold]
        return boxes[nms(boxes, self.detection.nms_iou)[: self.detection.max_detections]]

    def loss(self, samples: Sequence[FusionSample], targets: TargetBatch, loss: DetectionLoss) -> dict[str, Tensor]:
        """The detector's loss of the first stage in the ego's own map, and two terms of the second.

        "second_score" is the cross-entropy of scores with min(1, max(0, 2 IoU - 0.5)), IoU that of the proposal with
        the nearest object (as in PV-RCNN); "second_box" the smooth L1 loss of the refinement of proposals that
        overlap an object well enough. They are weighted as classification and box are.

        Raises:
            ValueError: a sample has no ground truth.
        """
        agents = [one for sample in samples for one in sample.observations]
        maps = self.share([torch.stack(scale) for scale in zip(*(one.features for one in agents), strict=True)])
        output = self.decode_maps(maps)
        first = np.cumsum([0, *(len(sample.observations) for sample in samples[:-1])]).tolist()
        terms = loss(HeadOutput(*(values[first] for values in output)), targets)._asdict()

        messages = self._messages(maps[0], output, agents)
        losses = []
        for start, sample in zip(first, samples, strict=True):
            if sample.truth is None:
                raise ValueError("truth: FPV-RCNN's second stage learns from the objects of a sample, got None")
            moved = [
                message.transform(pose) for message, pose in zip(messages[start:], sample.ego_SE2_agent, strict=False)
            ]
            losses.append(self._second_loss(moved, sample.truth, loss))
        score, box, proposals, right = (torch.stack(values).sum() for values in zip(*losses, strict=True))
        score, box = score / proposals.clamp(min=1.0), box / right.clamp(min=1.0)
        total = terms["total"] + loss.weights.classification * score + loss.weights.box * box
        return {**terms, "total": total, "second_score": score, "second_box": box}

    def _own_message(self, observation: PerceptionOutput) -> _Message:
        maps = self.share([m[None] for m in observation.features])
        (message,) = self._messages(maps[0], self.decode_maps(maps), [observation])
        return message

    def _messages(self, maps: Tensor, output: HeadOutput, agents: Sequence[PerceptionOutput]) -> list[_Message]:
        """The message of each agent, from its map (B, C, H, W) and the head's output."""
        proposing = self.detection.model_copy(update={"score_threshold": self.proposal_score})
        found = decode(HeadOutput(*(values.detach() for values in output)), self.anchors, proposing)
        messages = []
        for shared, observation, (proposals, *_) in zip(maps, agents, found, strict=True):
            proposals = proposals.replace(label=None)
            keypoints = select_keypoints(observation.points, proposals, _MARGIN, _KEYPOINTS)
            messages.append(_Message(proposals, keypoints, self.describe(self._at(keypoints, shared))))
        return messages

    def _at(self, points: Float32Array, shared: Tensor) -> Tensor:
        """(K, C) features of a map (C, H, W) at points (K, 3): bilinear, 0 outside."""
        low, high = np.array([self.config.x_range, self.config.y_range]).T
        place = torch.from_numpy((points[:, :2] - low) / (high - low) * 2.0 - 1.0).to(shared)
        return F.grid_sample(shared[None], place[None, None], align_corners=False)[0, :, 0].T

    def _decode(self, received: Received) -> _Message:
        rows = received.content["proposals"].astype(np.float64)
        proposals = Boxes(rows[:, :3], rows[:, 3:6], rows[:, 6], rows[:, 7])
        features = torch.from_numpy(received.content["features"].astype(np.float32)).to(self.describe.weight)
        return _Message(proposals, received.content["keypoints"], features).transform(received.ego_SE2_other)

    def _second_stage(self, messages: Sequence[_Message]) -> tuple[Boxes, IntArray, Tensor, Tensor]:
        """The R merged proposals, the number of proposals merged into each, logits (R,) and refinements (R, 7)."""
        proposals, count = merge_proposals(Boxes.concatenate([t.proposals for t in messages]), _SAME_OBJECT)
        features = torch.cat([t.features for t in messages])
        keypoints = np.concatenate([t.keypoints for t in messages])
        headings = np.repeat([t.heading for t in messages], [len(t.keypoints) for t in messages])
        inputs = (features.new_tensor(v) for v in (_rows(proposals), proposals.score, count, keypoints, headings))
        logits, refinement = self.second_stage(*inputs, features)
        return proposals, count, logits, refinement

    def _second_loss(self, messages: Sequence[_Message], truth: Boxes, loss: DetectionLoss) -> tuple[Tensor, ...]:
        """Sums over the proposals of one sample: of both terms, of proposals, and of those that overlap an object."""
        proposals, _, logits, refinement = self._second_stage(messages)
        truth = truth[truth.size[:, 2] > 0.0].replace(track_id=None)  # an unknown height cannot be learned
        if not len(proposals) or not len(truth):
            zero = logits.new_zeros(())
            return F.softplus(logits).sum(), zero, zero + len(proposals), zero
        iou = bev_iou(proposals, truth)
        object_of, best = iou.argmax(axis=1), iou.max(axis=1)
        wanted = torch.from_numpy(np.clip(2.0 * best - 0.5, 0.0, 1.0)).to(logits)
        score = F.binary_cross_entropy_with_logits(logits, wanted, reduction="sum")
        rows = np.flatnonzero(best >= _RIGHT)
        aim = torch.from_numpy(encode_refinement(truth[object_of[rows]], proposals[rows])).to(refinement)
        error = refinement[rows] - aim
        error = torch.cat([error[:, :6], error[:, 6:].sin()], dim=1)  # headings modulo pi
        box = F.smooth_l1_loss(error, torch.zeros_like(error), reduction="sum", beta=loss.weights.beta)
        return score, box, score.new_tensor(len(proposals)), score.new_tensor(len(rows))


def _rows(boxes: Boxes) -> np.ndarray[tuple[int, int], np.dtype[np.float64]]:
    """(N, 7) x, y, z, l, w, h [m], yaw [rad]."""
    return np.column_stack([boxes.center, boxes.size, boxes.yaw])
