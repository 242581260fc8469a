"""Preprocessing of samples and collation of batches, in the workers of the data loader."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from cobevglue.boxes import Boxes
from cobevglue.datasets.labelled_cloud import LabelledCloud
from cobevglue.perception import AnchorGrid, PointPillarsConfig, TargetBatch, Targets, assign_targets, collate_targets
from cobevglue.perception.point_pillars import check_points
from cobevglue.training.augmentation import AugmentationConfig, augment
from cobevglue.typing import BoolArray, Float32Array, FloatArray, IntArray

__all__ = ["Batch", "Batches", "Item"]


@dataclass(frozen=True, slots=True, eq=False)
class Item:
    """A preprocessed sample.

    Attributes:
        points: (N, 4) x, y, z [m] and intensity of the points in the detector's range.
        targets: of the head.
        truth: ground-truth boxes in the detector's range and the number of points on each, for validation; None in
            training.
    """

    points: Tensor
    targets: Targets
    truth: tuple[Boxes, IntArray] | None


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """A batch of B items.

    Attributes:
        points: (M, 4) concatenated clouds: one tensor is transferred between processes faster than many.
        counts: number of points of each cloud.
        targets: of all clouds.
        truth: of each cloud; empty in training.
    """

    points: Tensor
    counts: list[int]
    targets: TargetBatch
    truth: list[tuple[Boxes, IntArray]]

    def clouds(self, device: torch.device) -> list[Tensor]:
        """The B clouds, each (N_i, 4), on `device`."""
        return list(torch.split(self.points.to(device, non_blocking=True), self.counts))

    def pin_memory(self) -> Batch:
        """Copy to pinned memory, for asynchronous transfer to a GPU; called by the data loader."""
        t = self.targets
        targets = TargetBatch(*(x.pin_memory() for x in (t.positive, t.residuals, t.direction, t.ignored)))
        return Batch(self.points.pin_memory(), self.counts, targets, self.truth)


class Batches:
    """Preprocesses samples and collates them to batches; picklable."""

    def __init__(self, model: PointPillarsConfig, min_points: int, augmentation: AugmentationConfig | None) -> None:
        """Store the settings.

        Args:
            model: settings of the detector.
            min_points: objects with fewer points are ignored: neither targets nor background.
            augmentation: settings; None for validation, without augmentation and with ground truth.
        """
        self._model, self._min_points, self._augmentation = model, min_points, augmentation
        self._anchors = AnchorGrid(model)

    def prepare(self, sample: LabelledCloud, random: np.random.Generator) -> Item:
        """Augment and crop a sample, and assign its targets."""
        sample = replace(sample, points=check_points(sample.points))  # as in inference
        if self._augmentation is not None:
            sample = augment(sample, self._augmentation, random)
        boxes, points = sample.boxes, sample.points
        unknown_height = boxes.size[:, 2] <= 0.0
        ignore = (sample.point_count < self._min_points) | unknown_height
        rows = np.column_stack([boxes.center, boxes.size, boxes.yaw])
        rows[unknown_height, 5] = 1.0  # arbitrary: these boxes are not targets, but need a size
        truth = None
        if self._augmentation is None:
            inside = self._in_range(boxes.center[:, 0], boxes.center[:, 1])
            truth = boxes[inside], sample.point_count[inside]
        points = points[self._in_range(points[:, 0], points[:, 1])]
        return Item(torch.from_numpy(points), assign_targets(rows, ignore, self._anchors), truth)

    def collate(self, items: Sequence[Item]) -> Batch:
        """Collate items to a batch."""
        return Batch(
            points=torch.cat([item.points for item in items]),
            counts=[len(item.points) for item in items],
            targets=collate_targets([item.targets for item in items], len(self._anchors)),
            truth=[item.truth for item in items if item.truth is not None],
        )

    def _in_range(self, x: FloatArray | Float32Array, y: FloatArray | Float32Array) -> BoolArray:
        """(N,) whether positions x, y [m] are in the detector's range."""
        (x_min, x_max), (y_min, y_max) = self._model.x_range, self._model.y_range
        inside: BoolArray = (x >= x_min) & (x < x_max) & (y >= y_min) & (y < y_max)
        return inside
