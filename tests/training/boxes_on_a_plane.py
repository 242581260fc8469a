"""A tiny source of samples: boxes with points on them, on a plane with points on it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cobevglue import Boxes
from cobevglue.datasets.labelled_cloud import LabelledCloud, count_points


@dataclass(frozen=True)
class BoxesOnAPlane:
    """Worlds of a few cars around a LiDAR 1.8 m above the ground."""

    seed: int = 0
    samples: int = 4
    cars: int = 6
    reach: float = 12.0
    ground_points: int = 600
    points_on_car: int = 60

    def episode(self, index: int) -> list[LabelledCloud]:
        random = np.random.default_rng([self.seed, index])
        return [self._sample(random) for _ in range(self.samples)]

    def _sample(self, random: np.random.Generator) -> LabelledCloud:
        n, reach = self.cars, self.reach
        xy = random.uniform(-reach, reach, (n, 2))
        boxes = Boxes(
            center=np.column_stack([xy, np.full(n, -1.0)]),
            size=np.tile([4.4, 2.0, 1.6], (n, 1)) * random.uniform(0.9, 1.1, (n, 3)),
            yaw=random.uniform(-np.pi, np.pi, n),
        )
        on_cars = random.uniform(-0.5, 0.5, (n, self.points_on_car, 3)) * boxes.size[:, None]
        on_cars[..., 2] = 0.45 * boxes.size[:, None, 2]
        c, s = np.cos(boxes.yaw)[:, None], np.sin(boxes.yaw)[:, None]
        x, y = on_cars[..., 0].copy(), on_cars[..., 1].copy()
        on_cars[..., 0], on_cars[..., 1] = c * x - s * y, s * x + c * y
        on_cars += boxes.center[:, None]
        ground = np.column_stack(
            [random.uniform(-reach, reach, (self.ground_points, 2)), np.full(self.ground_points, -1.8)]
        )
        xyz = np.concatenate([on_cars.reshape(-1, 3), ground])
        points = np.column_stack([xyz, random.random(len(xyz))]).astype(np.float32)
        return LabelledCloud(points, boxes, count_points(points, boxes))
