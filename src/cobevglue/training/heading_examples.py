"""Examples for the training of heading refinement: detected vehicles, and whether their headings are correct.

A folder contains one safetensors file per episode of the source, see `shards`.
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

from cobevglue.datasets.atomic_files import atomic_write
from cobevglue.datasets.labelled_cloud import LabelledCloud
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

_MATCH_IOU = 0.5
"""Minimum bird's-eye-view IoU of a detection and its object, as in the evaluation of AP@0.5."""


@dataclass(frozen=True, slots=True, eq=False)
class HeadingExamples:
    """K detected vehicles.

    Attributes:
        inputs: of the refinement; points in float16, which resolves millimetres.
        correct: (K,) whether the heading of each detection is within 90 degrees of the true one.
    """

    inputs: HeadingInputs
    correct: Tensor

    def to(self, device: torch.device) -> HeadingExamples:
        """Copy to a device."""
        return HeadingExamples(HeadingInputs(*(values.to(device) for values in self.inputs)), self.correct.to(device))

    def take(self, rows: Tensor) -> HeadingExamples:
        """The examples in `rows` (R,), with points in float32."""
        inputs = HeadingInputs(*(values[rows] for values in self.inputs))
        return HeadingExamples(inputs._replace(points=inputs.points.float()), self.correct[rows])


@torch.inference_mode()
def examples_in(cloud: LabelledCloud, detector: PointPillars, min_points: int) -> HeadingExamples:
    """Examples of the detections in a cloud, without false positives and objects of fewer than `min_points` points."""
    points = check_points(cloud.points)
    points = correct_height(points, estimate_height_correction(points))
    (found,) = detector.boxes(detector([torch.from_numpy(points)]))
    iou = bev_iou(found.boxes, cloud.boxes)
    best = iou.max(axis=1, initial=0.0)
    of = iou.argmax(axis=1) if len(cloud.boxes) else np.zeros(len(iou), dtype=np.int64)
    known = np.flatnonzero(best >= _MATCH_IOU)
    known = known[cloud.point_count[of[known]] >= min_points]
    correct = np.abs(wrap_angle(found.boxes.yaw[known] - cloud.boxes.yaw[of[known]])) <= math.pi / 2
    inputs = HeadingInputs(*(values[torch.from_numpy(known)] for values in heading_inputs(points, found)))
    return HeadingExamples(inputs._replace(points=inputs.points.half()), torch.from_numpy(correct))


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
    """Compute the examples that are missing in a folder, and read all.

    Args:
        folder: created if missing.
        source: of the episodes.
        config: settings of the source; "episodes" is the number of episodes, "min_points" the argument of
            `examples_in`.
        detector: in evaluation mode.
        processes: number of processes.
        autocast: context of the detector's precision.
        device: of the detector.
        report: is called with each line of progress.

    Raises:
        ValueError: the folder was written with other settings or another detector; no object was detected.
    """
    episodes = config["episodes"]

    def progress(done: int, _: int) -> None:
        if done % 20 == 0 or done == episodes:
            report(f"{folder}: {done} of {episodes} episodes processed")

    first_stage = nn.ModuleList([detector.pillars, detector.backbone, detector.neck, detector.head])
    settings = {"config": dict(config), "detector": fingerprint(first_stage)}
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
    detector.to(device)  # here, because GPU tensors are not sent to processes
    with autocast:
        examples = [examples_in(cloud, detector, min_points) for cloud in source.episode(episode)]
    if not examples:
        return []
    inputs = {
        name: torch.cat(values)
        for name, values in zip(HeadingInputs._fields, zip(*(e.inputs for e in examples), strict=True), strict=True)
    }
    file = folder / f"{episode:04d}.safetensors"
    with atomic_write(file) as partial_file:
        save_file({**inputs, "right": torch.cat([e.correct for e in examples])}, partial_file)
    return [file.name]


def _read(folder: Path) -> HeadingExamples:
    parts = [load_file(folder / name) for name in read_index(folder)["files"]]
    if not sum(len(part["right"]) for part in parts):
        raise ValueError(f"{folder}: the detector found none of the objects")
    joined = {name: torch.cat([part[name] for part in parts]) for name in (*HeadingInputs._fields, "right")}
    return HeadingExamples(HeadingInputs(*(joined[name] for name in HeadingInputs._fields)), joined["right"])
