"""Training data of the fusion methods: features of the frozen detector for simulated frames, precomputed on disk.

A folder contains `index.json` with the settings and one safetensors file per frame, about 10 MB with three agents: the
encoder's maps in float16, detections, points, true poses, and the ground truth. The first agent is the ego.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
from pydantic import Field
from safetensors.torch import load_file, save_file
from torch import Tensor

from cobevglue.boxes import Boxes, covers_origin
from cobevglue.datasets.atomic_files import atomic_write
from cobevglue.datasets.frame import Frame
from cobevglue.datasets.labelled_cloud import count_points
from cobevglue.datasets.poses import inverse_SE3, transform_boxes
from cobevglue.fusion.early import merge_points
from cobevglue.fusion.method import Received
from cobevglue.perception import Perception, PerceptionOutput, PointPillars, PointPillarsConfig
from cobevglue.perception.checkpoint import fingerprint
from cobevglue.se2 import SE2
from cobevglue.settings import Settings
from cobevglue.simulation.scenario import ScenarioSettings, simulated_scenario
from cobevglue.training.run_log import print_progress
from cobevglue.training.shards import read_index, write_shards
from cobevglue.typing import BoolArray, Float32Array, FloatArray

__all__ = ["FeatureConfig", "FusionFrame", "FusionFrames", "make_frame", "write_features"]

_EGO_STREAM = 80


class FeatureConfig(Settings):
    """Settings of the simulated frames.

    Attributes:
        split: of the simulated worlds.
        scenarios: number of scenarios, each in a different world.
        frames: number of frames per scenario.
        interval: time between frames [s].
        agents: number of agents per scenario; successive scenarios cycle through the values.
        seed: of the scenarios.
        min_points: objects with fewer points, summed over all agents, are ignored.
    """

    split: str = "train"
    scenarios: Annotated[int, Field(ge=1)] = 200
    frames: Annotated[int, Field(ge=1)] = 6
    interval: Annotated[float, Field(gt=0.0)] = 3.0
    agents: Annotated[tuple[Annotated[int, Field(ge=1)], ...], Field(min_length=1)] = (2, 3)
    seed: Annotated[int, Field(ge=0)] = 40
    min_points: Annotated[int, Field(ge=0)] = 5


@dataclass(frozen=True, slots=True, eq=False)
class FusionFrame:
    """One frame of n agents, the ego first.

    Attributes:
        observations: outputs of perception of the n agents, each in its own LiDAR frame.
        world_SE3_agent: (n, 4, 4) true poses of the agents' LiDAR frames.
        early_features: the encoder's three maps of the merged cloud, in the ego's frame; None if not computed.
        truth: K objects visible to any agent, in the ego's frame.
        ignored: (K,) True for objects that are ignored: with too few points, or the ego itself.
    """

    observations: tuple[PerceptionOutput, ...]
    world_SE3_agent: FloatArray
    early_features: tuple[Tensor, Tensor, Tensor] | None
    truth: Boxes
    ignored: BoolArray

    def with_ego(self, number: int) -> FusionFrame:
        """The same frame with agent `number` as the ego; the vehicle of the previous ego stays ignored."""
        if number == 0:
            return self
        order = [number, *(other for other in range(len(self.observations)) if other != number)]
        poses = self.world_SE3_agent[order]
        truth = transform_boxes(self.truth, inverse_SE3(poses[0]) @ self.world_SE3_agent[0])
        observations = tuple(self.observations[agent] for agent in order)
        return FusionFrame(observations, poses, None, truth, self.ignored | covers_origin(truth))


def make_frame(frame: Frame, agents: Sequence[str], detector: PointPillars, min_points: int) -> FusionFrame:
    """Compute the features of a frame.

    Args:
        frame: with clouds of these agents.
        agents: names, the ego first.
        detector: in evaluation mode.
        min_points: see `FeatureConfig`.

    Raises:
        ValueError: the frame has no cloud of an agent.
    """
    clouds = [_cropped(frame, agent, detector.config) for agent in agents]
    poses = np.stack([frame.agents[agent].world_SE3_lidar for agent in agents])
    observations = tuple(Perception(detector).step(cloud) for cloud in clouds)
    truth = frame.ground_truth(agents[0], include_ego=True)
    points = np.zeros(len(truth), dtype=np.int64)
    received = []
    for cloud, pose in zip(clouds, poses, strict=True):
        points += count_points(cloud, transform_boxes(truth, inverse_SE3(pose) @ poses[0]))
        received.append(Received({"points": cloud}, SE2.from_matrix(inverse_SE3(poses[0]) @ pose)))
    with torch.inference_mode():
        merged = torch.from_numpy(merge_points(clouds[0], received[1:]))
        first, second, third = detector.multiscale(detector.encode([merged]))
    ignored = (points < min_points) | covers_origin(truth)
    return FusionFrame(observations, poses, (first[0], second[0], third[0]), truth, ignored)


class FusionFrames:
    """Sequence of frames on disk; `frames[i]` reads one."""

    def __init__(self, folder: Path) -> None:
        """Open a folder that `write_features` completed.

        Raises:
            FileNotFoundError: the folder is missing or incomplete.
        """
        content = read_index(folder)
        self.config = FeatureConfig.model_validate(content["config"])
        self.encoder: str = content["encoder"]
        self._files = [folder / name for name in content["files"]]

    def __len__(self) -> int:
        return len(self._files)

    def __getitem__(self, index: int) -> FusionFrame:
        return _read(self._files[index])


def write_features(
    folder: Path,
    config: FeatureConfig,
    detector: PointPillars,
    report: Callable[[str], None] = print_progress,
    processes: int = 1,
) -> FusionFrames:
    """Compute the features that are missing in a folder, and open it.

    Args:
        folder: created if missing.
        config: settings of the frames.
        detector: in evaluation mode.
        report: is called with each line of progress.
        processes: number of processes, with one thread each. One and several processes differ in floating-point
            rounding, because the numbers of threads differ.

    Raises:
        ValueError: the folder was written with other settings or another detector.
        ModuleNotFoundError: the packages for simulation are not installed.
    """
    wanted = {"config": json.loads(config.model_dump_json()), "encoder": fingerprint(detector)}

    def progress(scenarios: int, frames: int) -> None:
        if scenarios % 10 == 0 or scenarios == config.scenarios:
            report(f"features of {scenarios} of {config.scenarios} scenarios, {frames} frames")

    write = partial(_write_scenario, folder, config, detector)
    write_shards(folder, wanted, config.scenarios, write, processes, progress)
    return FusionFrames(folder)


def _write_scenario(folder: Path, config: FeatureConfig, detector: PointPillars, number: int) -> list[str]:
    files = []
    for index, frame in enumerate(_frames(number, config, detector)):
        file = folder / f"{number:04d}_{index:02d}.safetensors"
        with atomic_write(file) as partial:
            save_file(_as_tensors(frame), partial)
        files.append(file.name)
    return files


def _frames(number: int, config: FeatureConfig, detector: PointPillars) -> Iterator[FusionFrame]:
    """The frames of a scenario with at least two agents (one, if the scenario has one), with a random ego each."""
    agents = config.agents[number % len(config.agents)]
    settings = ScenarioSettings(frames=config.frames, rate=1.0 / config.interval, agents=agents)
    scenario = simulated_scenario(config.split, number, config.seed, settings)
    for index, frame in enumerate(scenario):
        order = np.random.default_rng([config.seed, _EGO_STREAM, number, index]).permutation(len(frame.agents))
        names = [list(frame.agents)[i] for i in order]
        if len(names) >= min(2, agents):
            yield make_frame(frame, names, detector, config.min_points)


def _cropped(frame: Frame, agent: str, config: PointPillarsConfig) -> Float32Array:
    """Points of an agent in the detector's range, (N, 4)."""
    points = frame.agents[agent].points
    if points is None:
        raise ValueError(f"{frame.scenario}/{frame.timestamp}: {agent}: no cloud is stored")
    ranges = np.array([config.x_range, config.y_range, config.z_range], dtype=np.float32)
    inside = ((points[:, :3] >= ranges[:, 0]) & (points[:, :3] < ranges[:, 1])).all(axis=1)
    return points[inside]


def _as_tensors(frame: FusionFrame) -> dict[str, Tensor]:
    tensors: dict[str, Any] = {"poses": frame.world_SE3_agent, "truth": _rows(frame.truth), "ignored": frame.ignored}
    assert frame.early_features is not None
    views = {f"{i}": view.features for i, view in enumerate(frame.observations)} | {"early": frame.early_features}
    for name, maps in views.items():
        tensors |= {f"{name}.map{i}": m.half().contiguous() for i, m in enumerate(maps)}
    for i, view in enumerate(frame.observations):
        tensors |= {
            f"{i}.points": view.points,
            f"{i}.boxes": _rows(view.boxes),
            f"{i}.variance": view.variance,
            f"{i}.detections": _rows(view.detections),
        }
    return {n: t if isinstance(t, Tensor) else torch.from_numpy(np.ascontiguousarray(t)) for n, t in tensors.items()}


def _read(file: Path) -> FusionFrame:
    tensors = load_file(file)

    def maps(name: str) -> tuple[Tensor, Tensor, Tensor]:
        first, second, third = (tensors[f"{name}.map{i}"].float() for i in range(3))
        return first, second, third

    observations = tuple(
        PerceptionOutput(
            points=tensors[f"{i}.points"].numpy(),
            features=maps(str(i)),
            boxes=_boxes(tensors[f"{i}.boxes"]),
            variance=tensors[f"{i}.variance"].numpy(),
            detections=_boxes(tensors[f"{i}.detections"]).replace(track_id=None),
            seconds={},
        )
        for i in range(len(tensors["poses"]))
    )
    truth = _boxes(tensors["truth"]).replace(score=None)
    return FusionFrame(observations, tensors["poses"].numpy(), maps("early"), truth, tensors["ignored"].numpy())


def _rows(boxes: Boxes) -> FloatArray:
    """(N, 9) x, y, z, l, w, h [m], yaw [rad], score (default 1), track id (default: the row)."""
    score = np.ones(len(boxes)) if boxes.score is None else boxes.score
    ids = np.arange(len(boxes)) if boxes.track_id is None else boxes.track_id
    rows: FloatArray = np.column_stack([boxes.center, boxes.size, boxes.yaw, score, ids])
    return rows


def _boxes(rows: Tensor) -> Boxes:
    r = rows.numpy()
    return Boxes(r[:, :3], r[:, 3:6], r[:, 6], r[:, 7], r[:, 8])
