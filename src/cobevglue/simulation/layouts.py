"""Layouts of data sets: locate, check and write the files of simulated scenarios in each data set's format."""

from __future__ import annotations

import json
from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

import cobevglue
from cobevglue.datasets.atomic_files import write_json
from cobevglue.datasets.dair_v2x_writer import (
    DAIRPair,
    DAIRSide,
    dair_v2x_frame_files,
    write_dair_v2x_frame,
    write_dair_v2x_index,
)
from cobevglue.datasets.opv2v_writer import write_opv2v_frame
from cobevglue.datasets.v2v4real_writer import write_v2v4real_frame
from cobevglue.simulation.road_network import NETWORKS
from cobevglue.simulation.scenario import ScenarioSettings, SimulatedScenario
from cobevglue.simulation.traffic import TrafficSnapshot
from cobevglue.simulation.world import LidarView
from cobevglue.typing import Float32Array, FloatArray, IntArray

__all__ = ["LAYOUTS", "DAIRV2XLayout", "Layout", "OPV2VLayout", "Task", "V2V4RealLayout"]

_MANIFEST = "simulation.json"
_KMH = 3.6


@dataclass(frozen=True)
class Task:
    """One scenario of a data set to write.

    Attributes:
        number: index of the scenario in its split, from 0.
        scenario: the scenario.
    """

    number: int
    scenario: SimulatedScenario


@dataclass(frozen=True)
class Layout(ABC):
    """Folders and files of a data set.

    Attributes:
        root: folder of the data set.
        split: name of the split.
        labels_only: write no clouds.
    """

    root: Path
    split: str
    labels_only: bool = False

    agents: ClassVar[int | None] = None
    """Number of vehicles in the format; None for any number."""
    roadside_units: ClassVar[int | None] = None
    """Number of roadside units in the format; None for any number."""

    def check(self, settings: ScenarioSettings) -> None:
        """Check that the format supports scenarios with these settings.

        Raises:
            ValueError: it does not.
        """
        for field in ("agents", "roadside_units"):
            required, got = getattr(self, field), getattr(settings, field)
            if required is not None and got != required:
                raise ValueError(f"{field.replace('_', ' ')}: this format has exactly {required}, got {got}")
        if settings.rate != 10.0:
            raise ValueError(f"rate: must be 10 Hz for this format's file names, got {settings.rate}")

    def claim(self, task: Task) -> None:
        """Write the scenario's manifest before its frames.

        Raises:
            ValueError: the folder contains another scenario, or files without a manifest.
        """
        path = self._manifest(task)
        scenario = task.scenario
        content = {
            "scenario": scenario.name,
            "network": scenario.network,
            "seed": scenario.seed,
            "settings": scenario.settings.model_dump(mode="json"),
            "cobevglue": cobevglue.__version__,
        }
        if path.exists():
            if _read_json(path) != content:
                raise ValueError(f"{path}: exists with other settings; choose another folder")
        elif self._has_foreign_files(task):
            raise ValueError(f"{path.parent}: exists without {path.name}: not written by this command")
        else:
            write_json(path, content, indent=1)

    def scenario_folder(self, task: Task) -> Path:
        """Folder of the scenario's manifest, which is reported to the user."""
        return self._manifest(task).parent

    @abstractmethod
    def missing(self, task: Task) -> list[int]:
        """Indices of the frames with missing files."""

    @abstractmethod
    def write(self, task: Task, index: int) -> None:
        """Write the missing files of one frame."""

    def finish(self, tasks: Sequence[Task]) -> None:  # noqa: B027
        """Write the files of the data set as a whole, after all frames."""

    @abstractmethod
    def _manifest(self, task: Task) -> Path: ...

    @abstractmethod
    def _has_foreign_files(self, task: Task) -> bool: ...

    def _points(self, view: LidarView) -> Float32Array | None:
        return None if self.labels_only else view.points


class _TreeLayout(Layout):
    """split / scenario / agent / number.{pcd,yaml}."""

    number_step: ClassVar[int]

    def missing(self, task: Task) -> list[int]:
        """See `Layout`."""
        folder, settings = self.scenario_folder(task), task.scenario.settings
        agents = [entry for entry in folder.iterdir() if entry.is_dir()]
        frames = range(len(task.scenario))
        if len(agents) < settings.agents + settings.roadside_units:
            return list(frames)
        existing = {(agent.name, file.name) for agent in agents for file in agent.iterdir()}
        return [
            index
            for index in frames
            if not all((agent.name, name) in existing for agent in agents for name in self._names(index))
        ]

    def write(self, task: Task, index: int) -> None:
        """See `Layout`."""
        folder, scenario = self.scenario_folder(task), task.scenario
        for number, (agent, view) in enumerate(scenario.views(index).items()):
            agent_folder = folder / self._agent_folder(number, scenario.carriers[agent])
            if not all((agent_folder / name).is_file() for name in self._names(index)):
                self._write(agent_folder, f"{self.number_step * index:06d}", scenario, index, agent, view)

    @abstractmethod
    def _agent_folder(self, number: int, carrier: int) -> str: ...

    @abstractmethod
    def _write(
        self, folder: Path, number: str, scenario: SimulatedScenario, index: int, agent: str, view: LidarView
    ) -> None: ...

    def _names(self, index: int) -> list[str]:
        number = f"{self.number_step * index:06d}"
        return [f"{number}.yaml"] if self.labels_only else [f"{number}.pcd", f"{number}.yaml"]

    def _manifest(self, task: Task) -> Path:
        return self.root / self.split / task.scenario.name / _MANIFEST

    def _has_foreign_files(self, task: Task) -> bool:
        folder = self.scenario_folder(task)
        return folder.exists() and any(folder.iterdir())


class OPV2VLayout(_TreeLayout):
    """OPV2V, or V2XSet with roadside units: agents are named by vehicle ids, roadside units by -1, -2 and so on."""

    number_step: ClassVar[int] = 2

    def _agent_folder(self, number: int, carrier: int) -> str:
        return str(carrier)

    def _write(
        self, folder: Path, number: str, scenario: SimulatedScenario, index: int, agent: str, view: LidarView
    ) -> None:
        snapshot, carrier = scenario.traffic[index], scenario.carriers[agent]
        speeds = _speeds(snapshot)
        write_opv2v_frame(
            folder,
            number,
            view.world_SE3_lidar,
            view.boxes,
            self._points(view),
            speeds=speeds,
            ego_speed=speeds.get(carrier, 0.0),
            world_SE3_vehicle=_world_SE3_vehicle(scenario, snapshot, carrier) if carrier >= 0 else None,
            point_counts=dict(zip(_ids(view).tolist(), view.point_count.tolist(), strict=True)),
        )


class V2V4RealLayout(_TreeLayout):
    """V2V4Real: two vehicles named 0 and 1."""

    number_step: ClassVar[int] = 1
    agents: ClassVar[int | None] = 2
    roadside_units: ClassVar[int | None] = 0

    def _agent_folder(self, number: int, carrier: int) -> str:
        return str(number)

    def _write(
        self, folder: Path, number: str, scenario: SimulatedScenario, index: int, agent: str, view: LidarView
    ) -> None:
        speeds = _speeds(scenario.traffic[index])
        write_v2v4real_frame(folder, number, view.world_SE3_lidar, view.boxes, self._points(view), speeds=speeds)


class DAIRV2XLayout(Layout):
    """DAIR-V2X-C: one vehicle and one roadside unit; each scenario is a batch."""

    agents: ClassVar[int | None] = 1
    roadside_units: ClassVar[int | None] = 1

    def missing(self, task: Task) -> list[int]:
        """See `Layout`."""
        return [
            index
            for index in range(len(task.scenario))
            if not all(
                path.is_file()
                for path in dair_v2x_frame_files(self.root, self._frame(task, index), not self.labels_only)
            )
        ]

    def write(self, task: Task, index: int) -> None:
        """See `Layout`."""
        frame = task.scenario[index]
        sides = [
            DAIRSide(agent.world_SE3_lidar, agent.objects, None if self.labels_only else agent.points)
            for agent in frame.agents.values()
        ]
        write_dair_v2x_frame(self.root, self._frame(task, index), sides[0], sides[1], frame.ground_truth("car1"))

    def finish(self, tasks: Sequence[Task]) -> None:
        """Write the index files."""
        pairs = [
            DAIRPair(self._frame(task, index), task.scenario.name, index / task.scenario.settings.rate)
            for task in tasks
            for index in range(len(task.scenario))
        ]
        write_dair_v2x_index(self.root, self.split, pairs)

    def _frame(self, task: Task, index: int) -> str:
        return f"{list(NETWORKS).index(self.split)}{task.number:03d}{index:04d}"

    def _manifest(self, task: Task) -> Path:
        return self.root / f"simulation_{self.split}_{task.number:03d}.json"

    def _has_foreign_files(self, task: Task) -> bool:
        return (self.root / "cooperative").exists() and not any(self.root.glob("simulation_*.json"))


LAYOUTS: dict[str, type[Layout]] = {"opv2v": OPV2VLayout, "v2v4real": V2V4RealLayout, "dair-v2x": DAIRV2XLayout}
"""Layouts by data set name."""


def _ids(view: LidarView) -> IntArray:
    assert view.boxes.track_id is not None
    return view.boxes.track_id


def _speeds(snapshot: TrafficSnapshot) -> dict[int, float]:
    """Speeds [km/h] by vehicle id, without parked vehicles."""
    return dict(zip(snapshot.id.tolist(), (_KMH * snapshot.speed).tolist(), strict=True))


def _world_SE3_vehicle(scenario: SimulatedScenario, snapshot: TrafficSnapshot, vehicle: int) -> FloatArray:
    """(4, 4) pose of a vehicle's centre on the ground, without roll and pitch."""
    row = int(np.flatnonzero(snapshot.id == vehicle)[0])
    x, y, yaw = float(snapshot.x[row]), float(snapshot.y[row]), float(snapshot.yaw[row])
    pose = np.eye(4)
    pose[:2, :2] = [[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]]
    pose[:3, 3] = x, y, float(scenario.world.scenery.ground.height([[x, y]])[0])
    return pose


def _read_json(path: Path) -> Any:
    try:
        return json.loads(path.read_text(encoding="utf-8"))
    except ValueError as error:
        raise ValueError(f"{path}: invalid JSON: {error}") from None
