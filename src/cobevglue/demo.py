"""The demonstration: collaborative perception of cars at a junction, with simulated LiDAR and the shipped weights.

The perception of each car runs once a frame. Its outputs are fused in five ways: not at all, with poses from noisy GPS,
from GPS under attack, from BEVGlue, which uses no localisation, and with the true poses.
"""

from __future__ import annotations

import math
import os
import platform
from collections.abc import Callable, Iterator, Mapping
from concurrent.futures import Executor, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any

import numpy as np

from cobevglue.alignment import group_aligner
from cobevglue.boxes import Boxes
from cobevglue.datasets.frame import AgentFrame, Frame
from cobevglue.datasets.poses import inverse_SE3
from cobevglue.disturbance import Disturbance, LocalisationNoise, ObservedFrame, SamePlace, Undisturbed
from cobevglue.evaluation.detection import DetectionFrame, evaluate_detections
from cobevglue.evaluation.detection_matching import DROPPED, FALSE, EvaluationRange, inside, match, prepare
from cobevglue.fusion.none import NoCollaboration
from cobevglue.perception import PerceptionOutput
from cobevglue.se2 import SE2
from cobevglue.simulation.road_network import RoadNetwork
from cobevglue.simulation.scenario import ScenarioSettings, SimulatedScenario
from cobevglue.simulation.world import LidarView
from cobevglue.system import CoBEVGlue, StepOutput
from cobevglue.torch_threads import torch_threads
from cobevglue.typing import BoolArray, Float32Array, FloatArray, IntArray

__all__ = [
    "COBEVGLUE",
    "EGO_ONLY",
    "FRAMES",
    "IOU",
    "MIN_POINTS",
    "NETWORK",
    "NOISE",
    "ROWS",
    "SCORE",
    "DemoFrame",
    "DemoResult",
    "Verdict",
    "run_demo",
]

EGO_ONLY, COBEVGLUE = "ego_only", "cobevglue"
ROWS = MappingProxyType(
    {
        EGO_ONLY: "ego only",
        "noisy_gps": "fused on noisy GPS",
        "attacked_gps": "fused under attack",
        COBEVGLUE: "CoBEVGlue",
        "true_pose": "true pose",
    }
)
"""The compared variants, with their titles."""

NOISE = LocalisationNoise(position=2.0, yaw=2.0)
"""Of the noisy GPS: standard deviations [m, degrees], of every car and frame independently."""

_GPS: dict[str, Disturbance] = {"noisy_gps": NOISE, "attacked_gps": SamePlace()}
"""Disturbances of the claimed poses by row; under attack all other agents claim the ego's pose."""

WEIGHTS, NETWORK, AGENTS = "compact", "junction_test_0", 3
"""The detector, the road network (of the test split), and the number of cars with a LiDAR."""

FRAMES, FRAMES_AT_MOST, RATE = 40, 200, 10.0
MIN_POINTS = 5
"""Vehicles with fewer points of all LiDARs together are not evaluated. Those with fewer points of the ego's own LiDAR
are hidden from it."""
SCORE, IOU = 0.3, 0.5
"""Minimum score of shown detections, and minimum IoU of true positives."""

_NEAR = 50.0  # what is hidden within this distance concerns the ego [m]
_MOVING = 1.0  # [m/s]
_WORKERS_AT_MOST = 4


@dataclass(frozen=True, eq=False, slots=True)
class Verdict:
    """True and false positives of one row in one frame.

    Attributes:
        boxes: K detections above the score threshold, in the ego frame.
        ghost: (K,) whether a detection is a false positive.
        found: (N,) whether each evaluated vehicle of the frame was detected.
    """

    boxes: Boxes
    ghost: BoolArray
    found: BoolArray


@dataclass(frozen=True, eq=False, slots=True)
class DemoFrame:
    """Data and results of one frame; poses and boxes are in the ego's LiDAR frame unless stated otherwise.

    Attributes:
        index: 0, 1, 2, …
        time: time stamp [s].
        ego: the name of the agent whose frame it is.
        reach: the detection and evaluation range.
        world_SE2_ego: the ego's pose.
        points: the clouds of all agents by name, (N, 4) float32, each in its own LiDAR frame.
        truth: N vehicles with at least one point of any agent, without the ego.
        point_count: (N,) points of all agents on each.
        own_point_count: (N,) those of the ego's.
        speed: (N,) [m/s].
        ego_SE2_others: the true poses of the others.
        tracked: the boxes that each agent detected and tracks, each in its own LiDAR frame.
        outputs: of the system, by row.
    """

    index: int
    time: float
    ego: str
    reach: EvaluationRange
    world_SE2_ego: SE2
    points: dict[str, Float32Array]
    truth: Boxes
    point_count: IntArray
    own_point_count: IntArray
    speed: FloatArray
    ego_SE2_others: dict[str, SE2]
    tracked: dict[str, Boxes] = field(default_factory=dict)
    outputs: dict[str, StepOutput] = field(default_factory=dict)

    @property
    def counted(self) -> BoolArray:
        """(N,) whether each vehicle is evaluated."""
        return inside(self.truth, self.reach) & (self.point_count >= MIN_POINTS)

    @property
    def hidden(self) -> BoolArray:
        """(N,) whether each evaluated vehicle is hidden from the ego."""
        return self.counted & (self.own_point_count < MIN_POINTS)

    @property
    def hidden_movers(self) -> IntArray:
        """Rows of hidden moving vehicles near the ego, the nearest first."""
        distance = np.hypot(self.truth.center[:, 0], self.truth.center[:, 1])
        rows = np.flatnonzero(self.hidden & (self.speed > _MOVING) & (distance < _NEAR))
        return rows[np.argsort(distance[rows], kind="stable")]

    def detections(self, row: str) -> DetectionFrame:
        """Detections and ground truth for average precision."""
        return DetectionFrame(self.outputs[row].boxes, self.truth, self.point_count, f"frame {self.index}")

    def verdict(self, row: str) -> Verdict:
        """True and false positives of a row."""
        scene = prepare(self.detections(row), self.reach, MIN_POINTS)
        objects = match(scene, IOU)
        confident = scene.score >= SCORE
        found = np.zeros(len(self.truth), dtype=np.bool_)
        found[objects[confident & (objects >= 0)]] = True
        shown = confident & (objects != DROPPED)
        return Verdict(scene.detections[shown], objects[shown] == FALSE, found)

    def used_poses(self, row: str) -> dict[str, SE2]:
        """The poses of the other agents that a row used; refused ones are left out."""
        found = self.outputs[row].alignments
        return {name: a.ego_SE2_other for name, a in found.items() if a.ego_SE2_other is not None}

    def pose_errors(self, row: str) -> list[tuple[float, float]]:
        """Errors of the used poses [m, rad]."""
        return [pose.error_to(self.ego_SE2_others[name]) for name, pose in self.used_poses(row).items()]


@dataclass(frozen=True, eq=False, slots=True)
class DemoResult:
    """The whole sequence.

    Attributes:
        seed: of the scene.
        roads: the network, in the world's frame.
        frames: results by frame.
    """

    seed: int
    roads: RoadNetwork
    frames: tuple[DemoFrame, ...]

    def story(self) -> DemoFrame:
        """The frame to show: the first with the most hidden moving vehicles near the ego.

        It is chosen by the ground truth, not by the detections.
        """
        return max(self.frames, key=lambda frame: len(frame.hidden_movers))

    def summary(self) -> dict[str, Any]:
        """Metrics of the sequence for JSON; units are in the names, counts are means per frame."""
        return {
            "seed": self.seed,
            "ego": self.frames[0].ego,
            "agents": max(len(frame.points) for frame in self.frames),
            "frames": len(self.frames),
            "vehicles": _mean([frame.counted.sum() for frame in self.frames]),
            "hidden_from_ego": _mean([frame.hidden.sum() for frame in self.frames]),
            "noise": {"xy_m": NOISE.position, "yaw_deg": NOISE.yaw},
            "rows": {row: self._row(row) for row in ROWS},
            "median_ms": self._times(),
            "machine": {"processor": platform.machine(), "python": platform.python_version()},
        }

    def _row(self, row: str) -> dict[str, Any]:
        report = evaluate_detections(
            (frame.detections(row) for frame in self.frames),
            thresholds=(0.5, 0.7),
            evaluation_range=self.frames[0].reach,
            min_points=MIN_POINTS,
        )
        verdicts = [frame.verdict(row) for frame in self.frames]
        errors = [error for frame in self.frames for error in frame.pose_errors(row)]
        others = [
            (output, name) for frame in self.frames for output in [frame.outputs[row]] for name in output.alignments
        ]
        return {
            "name": ROWS[row],
            "ap_0.5": report.ap(0.5),
            "ap_0.7": report.ap(0.7),
            "found": _mean([verdict.found.sum() for verdict in verdicts]),
            "hidden_found": _mean(
                [(v.found & frame.hidden).sum() for v, frame in zip(verdicts, self.frames, strict=True)]
            ),
            "ghosts": _mean([verdict.ghost.sum() for verdict in verdicts]),
            "poses_used": len(errors) / len(others) if others else None,
            "median_error_m": _median([metres for metres, _ in errors]),
            "median_error_deg": _median([math.degrees(radians) for _, radians in errors]),
            "bytes_for_pose": _mean([output.alignment_bytes[name] for output, name in others]),
            "bytes_in_all": _mean([sum(output.message_bytes[name].values()) for output, name in others]),
        }

    def _times(self) -> dict[str, float | None]:
        """Median time of each stage of CoBEVGlue for one frame of all agents; the first, which compiles, left out."""
        spent = [frame.outputs[COBEVGLUE].seconds for frame in self.frames[1:]]
        return {stage: _median([1e3 * seconds[stage] for seconds in spent]) for stage in (spent[0] if spent else ())}


def run_demo(seed: int = 0, *, frames: int = FRAMES, progress: Callable[[int], None] | None = None) -> DemoResult:
    """Simulate the sequence, and fuse the agents' observations frame by frame.

    The ego is the agent from which, in the middle of the drive, most vehicles are hidden that drive near it.

    Args:
        seed: of the scene and of the GPS noise, a whole number >= 0.
        frames: how many, at 10 Hz.
        progress: called after each frame with the number of frames done.

    Returns:
        What happened; the same for the same seed, but for the times that were measured.

    Raises:
        ValueError: the seed is negative, the number of frames out of range, or no agent stays all the time.
        ImportError: torch, libsumo, embreex or trimesh is not installed.
    """
    if not 1 <= frames <= FRAMES_AT_MOST:
        raise ValueError(f"frames must be from 1 to {FRAMES_AT_MOST}, got {frames}")
    settings = ScenarioSettings(frames=frames, rate=RATE, agents=AGENTS, max_distance=_NEAR)
    scenario = SimulatedScenario(NETWORK, seed, settings)
    systems = _systems()
    config = systems[COBEVGLUE].detector.config
    reach = (*config.x_range, *config.y_range)
    ego = _choose_ego(scenario, reach)
    done: list[DemoFrame] = []
    with _workers() as workers:
        coming = workers.submit(scenario.views, 0)
        for index in range(frames):
            views = coming.result()
            if index + 1 < frames:
                coming = workers.submit(scenario.views, index + 1)
            scene = _scene(scenario, index, ego, views, reach)
            done.append(_put_together(scene, _poses(views), scenario.seed, systems, workers))
            if progress is not None:
                progress(len(done))
    return DemoResult(seed, scenario.world.roads, tuple(done))


def _systems() -> dict[str, CoBEVGlue]:
    """A system for each row, all with the same detector and, but for ego only, the same fusion."""
    whole = CoBEVGlue.pretrained(WEIGHTS, fusion="cobevglue", aligner="bevglue")
    given = {row: CoBEVGlue(whole.detector, whole.fusion, group_aligner("given")) for row in ROWS}
    alone = CoBEVGlue(whole.detector, NoCollaboration(whole.detector), group_aligner("given"))
    return {**given, EGO_ONLY: alone, COBEVGLUE: whole}


def _choose_ego(scenario: SimulatedScenario, reach: EvaluationRange) -> str:
    staying = [
        name
        for name, carrier in scenario.carriers.items()
        if all(carrier in snapshot.id for snapshot in scenario.traffic)
    ]
    if not staying:
        raise ValueError(f"seed: in the drive of seed {scenario.seed} no agent stays all the time; take another")
    middle = len(scenario) // 2
    views = scenario.views(middle)
    return max(staying, key=lambda name: len(_scene(scenario, middle, name, views, reach).hidden_movers))


def _put_together(
    scene: DemoFrame,
    true: Mapping[str, FloatArray],
    seed: int,
    systems: Mapping[str, CoBEVGlue],
    workers: Executor,
) -> DemoFrame:
    """Perceive, and fuse by the method of every row; `true` are the poses world_SE3_lidar."""

    def perceive(name: str) -> PerceptionOutput:
        return systems[COBEVGLUE].perceive(name, scene.points[name], scene.time)

    seen = dict(zip(scene.points, workers.map(perceive, scene.points), strict=True))
    seconds = {"perception": sum(sum(view.seconds.values()) for view in seen.values())}
    moment = ObservedFrame(scene.time, seen, true, true)

    def collaborate(row: str) -> StepOutput:
        taking_part = {scene.ego: seen[scene.ego]} if row == EGO_ONLY else seen
        heard = _GPS.get(row, Undisturbed()).apply([moment], 0, scene.ego, [seed, scene.index])
        claimed = None if row == COBEVGLUE else heard.claimed
        return systems[row].collaborate(taking_part, scene.ego, scene.time, claimed, seconds)

    outputs = dict(zip(systems, workers.map(collaborate, systems), strict=True))
    return replace(scene, tracked={name: view.boxes for name, view in seen.items()}, outputs=outputs)


def _poses(views: Mapping[str, LidarView]) -> dict[str, FloatArray]:
    return {name: view.world_SE3_lidar for name, view in views.items()}


@contextmanager
def _workers() -> Iterator[Executor]:
    """Threads for what can be done at the same time.

    The network uses one thread meanwhile: on a busy machine several would mostly wait for each other.
    """
    with torch_threads(1), ThreadPoolExecutor(min(_WORKERS_AT_MOST, os.cpu_count() or 1)) as workers:
        yield workers


def _scene(
    scenario: SimulatedScenario, index: int, ego: str, views: Mapping[str, LidarView], reach: EvaluationRange
) -> DemoFrame:
    """One frame as it is, before anybody looked."""
    time, snapshot = index / RATE, scenario.traffic[index]
    agents = {name: _agent_frame(view) for name, view in views.items()}
    truth = Frame(scenario.name, scenario.timestamp(index), time, agents).ground_truth(ego)
    assert truth.track_id is not None
    counts = {name: _counts(view, truth.track_id) for name, view in views.items()}
    speed = dict(zip(snapshot.id.tolist(), snapshot.speed.tolist(), strict=True))  # parked ones are not in there
    ego_SE3_world = inverse_SE3(views[ego].world_SE3_lidar)
    return DemoFrame(
        index=index,
        time=time,
        ego=ego,
        reach=reach,
        world_SE2_ego=SE2.from_matrix(views[ego].world_SE3_lidar),
        points={name: view.points for name, view in views.items()},
        truth=truth,
        point_count=np.sum(list(counts.values()), axis=0),
        own_point_count=counts[ego],
        speed=np.array([speed.get(vehicle, 0.0) for vehicle in truth.track_id.tolist()]),
        ego_SE2_others={
            name: SE2.from_matrix(ego_SE3_world @ view.world_SE3_lidar) for name, view in views.items() if name != ego
        },
    )


def _agent_frame(view: LidarView) -> AgentFrame:
    return AgentFrame(lambda: (view.world_SE3_lidar, view.boxes), lambda: view.points)


def _counts(view: LidarView, vehicles: IntArray) -> IntArray:
    """(N,) points of one agent on each of these vehicles."""
    assert view.boxes.track_id is not None
    known = dict(zip(view.boxes.track_id.tolist(), view.point_count.tolist(), strict=True))
    return np.array([known.get(vehicle, 0) for vehicle in vehicles.tolist()], dtype=np.int64)


def _mean(values: Any) -> float | None:
    return float(np.mean(values)) if len(values) else None


def _median(values: Any) -> float | None:
    return float(np.median(values)) if len(values) else None
