"""What the fusion methods are trained on: the frozen detector's view of many frames, computed once and kept on disk.

A folder has an `index.json` with the settings and one safetensors file a frame, about 10 MB with three agents: the
encoder's maps in float16, detections, points, true poses, and the objects to find. The first agent is the ego.
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
from cobevglue.datasets.frame import Frame
from cobevglue.datasets.labelled_cloud import count_points
from cobevglue.datasets.poses import inverse_SE3, transform_boxes
from cobevglue.datasets.whole_files import whole_file
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
    """Which simulated frames.

    Attributes:
        split: of the simulated worlds.
        scenarios: drives, each in another world.
        frames: of each drive.
        interval: between frames [s].
        agents: how many see each drive, one number after the other.
        seed: of the drives.
        min_points: an object with fewer points of all agents together is neither to be found nor wrong to find.
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
    """One frame as several agents saw it, the ego first.

    Attributes:
        seen: what each of the n agents saw, each in its own LiDAR frame.
        world_SE3_agent: (n, 4, 4) true poses.
        early_features: the encoder's three maps of the merged cloud, in the ego's frame; None where they are not known.
        truth: objects that any agent could see, in the ego's frame.
        ignored: (K,) which of them are neither to be found nor wrong to find: hardly any points, or the ego itself.
    """

    observations: tuple[PerceptionOutput, ...]
    world_SE3_agent: FloatArray
    early_features: tuple[Tensor, Tensor, Tensor] | None
    truth: Boxes
    ignored: BoolArray

    def with_ego(self, number: int) -> FusionFrame:
        """The same frame with agent `number` as the ego; the vehicle of the ego before stays ignored."""
        if number == 0:
            return self
        order = [number, *(other for other in range(len(self.observations)) if other != number)]
        poses = self.world_SE3_agent[order]
        truth = transform_boxes(self.truth, inverse_SE3(poses[0]) @ self.world_SE3_agent[0])
        seen = tuple(self.observations[agent] for agent in order)
        return FusionFrame(seen, poses, None, truth, self.ignored | covers_origin(truth))


def make_frame(frame: Frame, agents: Sequence[str], detector: PointPillars, min_points: int) -> FusionFrame:
    """What the detector sees of a frame.

    Args:
        frame: with clouds of these agents.
        agents: names, the ego first.
        detector: in evaluation mode.
        min_points: see `FeatureConfig`.

    Raises:
        ValueError: an agent has no cloud.
    """
    clouds = [_cropped(frame, agent, detector.config) for agent in agents]
    poses = np.stack([frame.agents[agent].world_SE3_lidar for agent in agents])
    seen = tuple(Perception(detector).step(cloud) for cloud in clouds)
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
    return FusionFrame(seen, poses, (first[0], second[0], third[0]), truth, ignored)


class FusionFrames:
    """Frames on disk: `frames[i]`."""

    def __init__(self, folder: Path) -> None:
        """Open a folder that `write_features` has finished.

        Raises:
            FileNotFoundError: there is none.
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
    """Compute features, or what is missing of them; a finished folder of the same settings is taken as it is.

    Args:
        folder: made where missing.
        config: which frames.
        detector: in evaluation mode.
        report: takes lines of progress.
        processes: how many make drives side by side, with one thread each; features differ in
            their last digit between one and many.

    Raises:
        ValueError: the folder was made with other settings or another detector.
        ModuleNotFoundError: what simulates is not installed.
    """
    wanted = {"config": json.loads(config.model_dump_json()), "encoder": fingerprint(detector)}

    def progress(drives: int, frames: int) -> None:
        if drives % 10 == 0 or drives == config.scenarios:
            report(f"features of {drives} of {config.scenarios} drives, {frames} frames")

    write = partial(_write_scenario, folder, config, detector)
    write_shards(folder, wanted, config.scenarios, write, processes, progress)
    return FusionFrames(folder)


def _write_scenario(folder: Path, config: FeatureConfig, detector: PointPillars, number: int) -> list[str]:
    files = []
    for index, frame in enumerate(_frames(number, config, detector)):
        file = folder / f"{number:04d}_{index:02d}.safetensors"
        with whole_file(file) as partial:
            save_file(_as_tensors(frame), partial)
        files.append(file.name)
    return files


def _frames(number: int, config: FeatureConfig, detector: PointPillars) -> Iterator[FusionFrame]:
    """The frames of a drive that at least two agents see, each with another ego."""
    agents = config.agents[number % len(config.agents)]
    settings = ScenarioSettings(frames=config.frames, rate=1.0 / config.interval, agents=agents)
    scenario = simulated_scenario(config.split, number, config.seed, settings)
    for index, frame in enumerate(scenario):
        order = np.random.default_rng([config.seed, _EGO_STREAM, number, index]).permutation(len(frame.agents))
        names = [list(frame.agents)[i] for i in order]
        if len(names) >= min(2, agents):
            yield make_frame(frame, names, detector, config.min_points)


def _cropped(frame: Frame, agent: str, config: PointPillarsConfig) -> Float32Array:
    """The agent's points in the detector's range."""
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

    seen = tuple(
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
    return FusionFrame(seen, tensors["poses"].numpy(), maps("early"), truth, tensors["ignored"].numpy())


def _rows(boxes: Boxes) -> FloatArray:
    """(N, 9) x, y, z, l, w, h [m], yaw [rad], score (1 where there is none), track id (the row where there is none)."""
    score = np.ones(len(boxes)) if boxes.score is None else boxes.score
    ids = np.arange(len(boxes)) if boxes.track_id is None else boxes.track_id
    rows: FloatArray = np.column_stack([boxes.center, boxes.size, boxes.yaw, score, ids])
    return rows


def _boxes(rows: Tensor) -> Boxes:
    r = rows.numpy()
    return Boxes(r[:, :3], r[:, 3:6], r[:, 6], r[:, 7], r[:, 8])
