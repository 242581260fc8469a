"""FPV-RCNN (Yuan et al., RA-L 2022): agents share what they detected and features of some points on it.

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
"""Most of an agent; the paper has 2048 before those outside proposals are dropped."""
_FEATURES = 32
"""Of a keypoint; the fewest that the paper tries, with hardly a loss."""
_MARGIN = 0.3
"""By how much proposals are enlarged on every side [m], to have the points of what they missed."""
_SAME_OBJECT = 0.15
"""Rotated overlap from which on two agents' proposals are of one object: that of non-maximum suppression."""
_RIGHT = 0.3
"""Overlap with an object from which on a proposal learns to become it. With poses that are off, few overlap by more."""


@dataclass(frozen=True, slots=True, eq=False)
class _Told:
    """What one agent tells: boxes with scores, (K, 3) keypoints [m] in the same frame, (K, F) features.

    `heading` is the agent's own in that frame [rad]: features say directions in the agent's.
    """

    proposals: Boxes
    keypoints: Float32Array
    features: Tensor
    heading: float = 0.0

    def seen_from(self, ego_SE2_other: SE2) -> _Told:
        return replace(
            self,
            proposals=self.proposals.transform(ego_SE2_other),
            keypoints=ego_SE2_other.apply(self.keypoints).astype(np.float32),
            heading=self.heading + ego_SE2_other.yaw,
        )


class FPVRCNN(SingleMapFusion):
    """Two stages. The first is every agent's own: what its head finds in its own map are its proposals.

    In the second, proposals of all agents are merged, and what the keypoints in each say decides where it is and how
    likely an object. A message has up to `detection.max_detections` proposals of 32 bytes and 1024 keypoints of 76.

    Attributes:
        proposal_score: detections that score less are no proposals.
    """

    usual_aligner = "fpv-rcnn"
    proposal_score: float = 0.1

    def __init__(self, detector: PointPillars) -> None:
        super().__init__(detector)
        self.describe = nn.Linear(self.config.shrink_channels, _FEATURES)
        self.second_stage = RoIHead(_FEATURES, _MARGIN)

    def conditioned_channels(self) -> Sequence[int]:
        """None: no maps are shared, and the second stage turns what keypoints say."""
        return []

    def fuse_maps(self, maps: Sequence[Tensor], covered: Sequence[Tensor]) -> list[Tensor]:
        """The ego's own map: the first stage is not fused."""
        return [maps[0][0]]

    @torch.inference_mode()
    def message(self, seen: PerceptionOutput) -> Arrays:
        """Proposals and keypoints in the sender's LiDAR frame, and the keypoints' features.

        (P, 8) float32 x, y, z, l, w, h [m], yaw [rad], score; (K, 3) float32 x, y, z [m]; (K, F) float16.
        """
        told = self._look(seen)
        assert told.proposals.score is not None
        proposals = np.column_stack([_rows(told.proposals), told.proposals.score]).astype(np.float32)
        return {"proposals": proposals, "keypoints": told.keypoints, "features": _half(told.features)}

    @torch.inference_mode()
    def fuse(self, ego: PerceptionOutput, received: Sequence[Received]) -> Boxes:
        """The merged proposals after the second stage, best first."""
        told = [self._look(ego), *(self._read(other) for other in received)]
        proposals, _, logits, refinement = self._second_stage(told)
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
            ValueError: a sample comes without its truth.
        """
        agents = [seen for sample in samples for seen in sample.observations]
        maps = self.share([torch.stack(scale) for scale in zip(*(seen.features for seen in agents), strict=True)])
        output = self.decode_maps(maps)
        first = np.cumsum([0, *(len(sample.observations) for sample in samples[:-1])]).tolist()
        terms = loss(HeadOutput(*(values[first] for values in output)), targets)._asdict()

        told = self._told(maps[0], output, agents)
        losses = []
        for start, sample in zip(first, samples, strict=True):
            if sample.truth is None:
                raise ValueError("truth: FPV-RCNN's second stage learns from the objects of a sample, got None")
            moved = [t.seen_from(pose) for t, pose in zip(told[start:], sample.ego_SE2_agent, strict=False)]
            losses.append(self._second_loss(moved, sample.truth, loss))
        score, box, proposals, right = (torch.stack(values).sum() for values in zip(*losses, strict=True))
        score, box = score / proposals.clamp(min=1.0), box / right.clamp(min=1.0)
        total = terms["total"] + loss.weights.classification * score + loss.weights.box * box
        return {**terms, "total": total, "second_score": score, "second_box": box}

    def _look(self, seen: PerceptionOutput) -> _Told:
        maps = self.share([m[None] for m in seen.features])
        (told,) = self._told(maps[0], self.decode_maps(maps), [seen])
        return told

    def _told(self, maps: Tensor, output: HeadOutput, agents: Sequence[PerceptionOutput]) -> list[_Told]:
        """What each agent has to tell, by its map (B, C, H, W) and what the head says of it."""
        proposing = self.detection.model_copy(update={"score_threshold": self.proposal_score})
        found = decode(HeadOutput(*(values.detach() for values in output)), self.anchors, proposing)
        told = []
        for shared, seen, (proposals, *_) in zip(maps, agents, found, strict=True):
            proposals = proposals.replace(label=None)
            keypoints = select_keypoints(seen.points, proposals, _MARGIN, _KEYPOINTS)
            told.append(_Told(proposals, keypoints, self.describe(self._at(keypoints, shared))))
        return told

    def _at(self, points: Float32Array, shared: Tensor) -> Tensor:
        """(K, C) features of a map (C, H, W) where these points (K, 3) are: bilinear, 0 outside."""
        low, high = np.array([self.config.x_range, self.config.y_range]).T
        place = torch.from_numpy((points[:, :2] - low) / (high - low) * 2.0 - 1.0).to(shared)
        return F.grid_sample(shared[None], place[None, None], align_corners=False)[0, :, 0].T

    def _read(self, received: Received) -> _Told:
        rows = received.content["proposals"].astype(np.float64)
        proposals = Boxes(rows[:, :3], rows[:, 3:6], rows[:, 6], rows[:, 7])
        features = torch.from_numpy(received.content["features"].astype(np.float32)).to(self.describe.weight)
        return _Told(proposals, received.content["keypoints"], features).seen_from(received.ego_SE2_other)

    def _second_stage(self, told: Sequence[_Told]) -> tuple[Boxes, IntArray, Tensor, Tensor]:
        """The R merged proposals, how many each is made of, logits (R,) and refinements (R, 7)."""
        proposals, count = merge_proposals(Boxes.concatenate([t.proposals for t in told]), _SAME_OBJECT)
        features = torch.cat([t.features for t in told])
        keypoints = np.concatenate([t.keypoints for t in told])
        headings = np.repeat([t.heading for t in told], [len(t.keypoints) for t in told])
        inputs = (features.new_tensor(v) for v in (_rows(proposals), proposals.score, count, keypoints, headings))
        logits, refinement = self.second_stage(*inputs, features)
        return proposals, count, logits, refinement

    def _second_loss(self, told: Sequence[_Told], truth: Boxes, loss: DetectionLoss) -> tuple[Tensor, ...]:
        """Sums over the proposals of one sample: of both terms, of proposals, and of those that overlap an object."""
        proposals, _, logits, refinement = self._second_stage(told)
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
