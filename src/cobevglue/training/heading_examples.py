"""What front and back are learnt from: vehicles that a detector found, and whether it had them the right way round.

A folder has one safetensors file for each episode of the source, see `shards`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor, nn

from cobevglue.datasets.labelled_cloud import LabelledCloud
from cobevglue.datasets.whole_files import whole_file
from cobevglue.iou import bev_iou
from cobevglue.perception import PointPillars
from cobevglue.perception.checkpoint import fingerprint
from cobevglue.perception.ground_height import correct_height, estimate_height_correction
from cobevglue.perception.heading import HeadingInputs, heading_inputs
from cobevglue.perception.point_pillars import check_points
from cobevglue.se2 import wrap_angle
from cobevglue.training.samples import EpisodeSource
from cobevglue.training.shards import read_index, write_shards

__all__ = ["HeadingExamples", "examples_in", "write_heading_examples"]

_FOUND = 0.5
"""Overlap with an object from which on a box is of it, as where average precision is measured."""


@dataclass(frozen=True, slots=True, eq=False)
class HeadingExamples:
    """Vehicles that were found.

    Attributes:
        looks: of K vehicles; points in float16, which is millimetres.
        right: (K,) whether each box faces as its vehicle does.
    """

    looks: HeadingInputs
    right: Tensor

    def to(self, device: torch.device) -> HeadingExamples:
        """The same on another device."""
        return HeadingExamples(HeadingInputs(*(values.to(device) for values in self.looks)), self.right.to(device))

    def take(self, rows: Tensor) -> HeadingExamples:
        """Those in these rows, in the precision of a network."""
        looks = HeadingInputs(*(values[rows] for values in self.looks))
        return HeadingExamples(looks._replace(points=looks.points.float()), self.right[rows])


@torch.inference_mode()
def examples_in(cloud: LabelledCloud, detector: PointPillars, min_points: int) -> HeadingExamples:
    """What the detector finds in a cloud, without what is no object or one with fewer points than `min_points`."""
    points = check_points(cloud.points)
    points = correct_height(points, estimate_height_correction(points))
    (found,) = detector.boxes(detector([torch.from_numpy(points)]))
    iou = bev_iou(found.boxes, cloud.boxes)
    best = iou.max(axis=1, initial=0.0)
    of = iou.argmax(axis=1) if len(cloud.boxes) else np.zeros(len(iou), dtype=np.int64)
    known = np.flatnonzero(best >= _FOUND)
    known = known[cloud.point_count[of[known]] >= min_points]
    right = np.abs(wrap_angle(found.boxes.yaw[known] - cloud.boxes.yaw[of[known]])) <= math.pi / 2
    looks = HeadingInputs(*(values[torch.from_numpy(known)] for values in heading_inputs(points, found)))
    return HeadingExamples(looks._replace(points=looks.points.half()), torch.from_numpy(right))


def write_heading_examples(
    folder: Path,
    source: EpisodeSource,
    config: Mapping[str, Any],
    detector: PointPillars,
    processes: int,
    autocast: torch.autocast,
    device: torch.device,
    report: Callable[[str], None],
) -> HeadingExamples:
    """Look at episodes, or at those that are missing; a finished folder of the same settings is taken as it is.

    Args:
        folder: made where missing.
        source: gives the episodes.
        config: what the source was made of; of it, "episodes" says how many to look at, "min_points" is that of
            `examples_in`.
        detector: in evaluation mode.
        processes: how many look at episodes side by side.
        autocast: the precision that the detector looks in.
        device: where it looks.
        report: takes lines of progress.

    Raises:
        ValueError: the folder was made with other settings or another detector; nothing was found.
    """
    episodes = config["episodes"]

    def progress(done: int, _: int) -> None:
        if done % 20 == 0 or done == episodes:
            report(f"{folder}: looked at {done} of {episodes} episodes")

    first_look = nn.ModuleList([detector.pillars, detector.backbone, detector.neck, detector.head])
    settings = {"config": dict(config), "detector": fingerprint(first_look)}
    write = partial(_write, folder, source, detector, autocast, device, config["min_points"])
    write_shards(folder, settings, episodes, write, processes, progress)
    return _read(folder)


def _write(
    folder: Path,
    source: EpisodeSource,
    detector: PointPillars,
    autocast: torch.autocast,
    device: torch.device,
    min_points: int,
    episode: int,
) -> list[str]:
    detector.to(device)  # here: another process cannot be sent what lies on a GPU
    with autocast:
        examples = [examples_in(cloud, detector, min_points) for cloud in source.episode(episode)]
    if not examples:
        return []
    looks = {
        name: torch.cat(values)
        for name, values in zip(HeadingInputs._fields, zip(*(e.looks for e in examples), strict=True), strict=True)
    }
    file = folder / f"{episode:04d}.safetensors"
    with whole_file(file) as partly:
        save_file({**looks, "right": torch.cat([e.right for e in examples])}, partly)
    return [file.name]


def _read(folder: Path) -> HeadingExamples:
    parts = [load_file(folder / name) for name in read_index(folder)["files"]]
    if not sum(len(part["right"]) for part in parts):
        raise ValueError(f"{folder}: the detector found none of the objects")
    joined = {name: torch.cat([part[name] for part in parts]) for name in (*HeadingInputs._fields, "right")}
    return HeadingExamples(HeadingInputs(*(joined[name] for name in HeadingInputs._fields)), joined["right"])
