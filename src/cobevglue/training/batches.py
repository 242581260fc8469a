"""From a sample to what a step of training needs; all of it happens in the data loader's workers."""

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
    """A sample made ready.

    Attributes:
        points: (N, 4) those in the detector's range.
        targets: what the head should say.
        truth: boxes and the points on each, for validation; None in training.
    """

    points: Tensor
    targets: Targets
    truth: tuple[Boxes, IntArray] | None


@dataclass(frozen=True, slots=True, eq=False)
class Batch:
    """B items.

    Attributes:
        points: (M, 4) of all clouds, one after the other: one tensor is sent between processes faster than many.
        counts: points of each cloud.
        targets: of all clouds.
        truth: of each, or empty in training.
    """

    points: Tensor
    counts: list[int]
    targets: TargetBatch
    truth: list[tuple[Boxes, IntArray]]

    def clouds(self, device: torch.device) -> list[Tensor]:
        """The clouds (N_i, 4) on a device."""
        return list(torch.split(self.points.to(device, non_blocking=True), self.counts))

    def pin_memory(self) -> Batch:
        """The same in memory that a GPU can fetch by itself; called by torch's data loader."""
        t = self.targets
        targets = TargetBatch(*(x.pin_memory() for x in (t.positive, t.residuals, t.direction, t.ignored)))
        return Batch(self.points.pin_memory(), self.counts, targets, self.truth)


class Batches:
    """Makes items of samples, and a batch of items; picklable."""

    def __init__(self, model: PointPillarsConfig, min_points: int, augmentation: AugmentationConfig | None) -> None:
        """Keep the settings.

        Args:
            model: of the detector.
            min_points: objects with fewer are neither targets nor background.
            augmentation: how samples are changed; None leaves them and keeps their truth, for validation.
        """
        self._model, self._min_points, self._augmentation = model, min_points, augmentation
        self._anchors = AnchorGrid(model)

    def prepare(self, sample: LabelledCloud, random: np.random.Generator) -> Item:
        """The sample, augmented and cropped, with targets."""
        sample = replace(sample, points=check_points(sample.points))  # as the detector does when it is used
        if self._augmentation is not None:
            sample = augment(sample, self._augmentation, random)
        boxes, points = sample.boxes, sample.points
        unknown_height = boxes.size[:, 2] <= 0.0
        ignore = (sample.point_count < self._min_points) | unknown_height
        rows = np.column_stack([boxes.center, boxes.size, boxes.yaw])
        rows[unknown_height, 5] = 1.0  # any: such boxes are no targets, but need a size
        truth = None
        if self._augmentation is None:
            inside = self._in_range(boxes.center[:, 0], boxes.center[:, 1])
            truth = boxes[inside], sample.point_count[inside]
        points = points[self._in_range(points[:, 0], points[:, 1])]
        return Item(torch.from_numpy(points), assign_targets(rows, ignore, self._anchors), truth)

    def collate(self, items: Sequence[Item]) -> Batch:
        """A batch of items."""
        return Batch(
            points=torch.cat([item.points for item in items]),
            counts=[len(item.points) for item in items],
            targets=collate_targets([item.targets for item in items], len(self._anchors)),
            truth=[item.truth for item in items if item.truth is not None],
        )

    def _in_range(self, x: FloatArray | Float32Array, y: FloatArray | Float32Array) -> BoolArray:
        """(N,) whether the detector looks there, seen from above [m]."""
        (x_min, x_max), (y_min, y_max) = self._model.x_range, self._model.y_range
        inside: BoolArray = (x >= x_min) & (x < x_max) & (y >= y_min) & (y < y_max)
        return inside
