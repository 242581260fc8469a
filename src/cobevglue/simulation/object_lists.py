"""Object lists that several agents detect in a scene, with the ground truth; deterministic for a seed.

    for frame in Junction(seed=1):
        ego, other = frame.agents["car1"], frame.agents["car2"]
        ego.boxes, other.boxes                  # what each detected, in its own LiDAR frame
        frame.ego_SE2_other("car1", "car2")     # the true relative pose
        frame.matches("car1", "car2")           # pairs of rows of the same vehicle

Without LiDAR simulation: detections are the visible true boxes with the errors of `DetectionErrors`. `Junction` is a
sequence of frames; `observe` is the view of one agent of any scene of `object_scenes` at any time.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from pydantic import Field

from cobevglue.boxes import Boxes
from cobevglue.disturbance.detection_errors import DetectionErrors, add_detection_errors
from cobevglue.se2 import SE2
from cobevglue.settings import Settings
from cobevglue.simulation.object_scenes import Mast
from cobevglue.simulation.object_scenes.junction import place_traffic
from cobevglue.simulation.scripted_traffic import LIDAR_HEIGHT
from cobevglue.simulation.visibility import is_visible
from cobevglue.typing import IntArray

__all__ = ["AgentView", "Junction", "JunctionSettings", "ObjectListFrame", "SensorSettings", "observe"]

_TRAFFIC_STREAM = 0
_FIRST_DETECTION_STREAM = 1  # and one stream more for each agent after the first

_Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]


class SensorSettings(Settings):
    """What an agent detects.

    Attributes:
        sensor_range: maximum distance of visible objects' centres [m].
        min_visible: minimum unoccluded share of a visible object's angular width.
        errors: detection errors; `DetectionErrors.none()` for perfect detectors.
    """

    sensor_range: _Positive = 70.0
    min_visible: Annotated[float, Field(ge=0.0, le=1.0)] = 0.3
    errors: DetectionErrors = DetectionErrors()


class JunctionSettings(SensorSettings):
    """Settings of the junction.

    Attributes:
        agents: number of agents, 1 to 8; named car1, car2, …; the first four start on different arms.
        vehicles: number of vehicles including agents, 1 to 100.
        duration: duration of the scene [s].
        rate: frame rate [Hz].
        sensor_range: maximum distance of visible objects' centres [m].
        min_visible: minimum unoccluded share of a visible object's angular width.
        errors: detection errors; `DetectionErrors.none()` for perfect detectors.

    Raises:
        ValueError: a value out of its range, an unknown field, or fewer vehicles than agents.
    """

    agents: Annotated[int, Field(ge=1, le=8)] = 2
    vehicles: Annotated[int, Field(ge=1, le=100)] = 32
    duration: _Positive = 8.0
    rate: _Positive = 10.0


@dataclass(frozen=True, eq=False, slots=True)
class AgentView:
    """Detections of one agent in one frame, with the ground truth.

    Attributes:
        boxes: the M detections with scores and labels, without track ids, in the agent's LiDAR frame.
        object_id: (M,) object id of each detection, -1 for a false positive.
        visible: true boxes of all visible objects in the agent's LiDAR frame; track_id is the object id.
        world_SE2_agent: pose of the agent.
        own_id: object id of the agent itself, which only other agents detect; -1 for a mast.
        body: one-row true box of the agent's own vehicle in its LiDAR frame; None for a mast.
    """

    boxes: Boxes
    object_id: IntArray
    visible: Boxes
    world_SE2_agent: SE2
    own_id: int
    body: Boxes | None


@dataclass(frozen=True, eq=False, slots=True)
class ObjectListFrame:
    """One time step.

    Attributes:
        index: 0, 1, 2, …
        time: time stamp [s].
        agents: views by agent name.
        objects: true boxes of all vehicles in the world frame; track_id is the object id.
    """

    index: int
    time: float
    agents: dict[str, AgentView]
    objects: Boxes

    def ego_SE2_other(self, ego: str, other: str) -> SE2:
        """True relative pose of two agents: maps the other's coordinates to the ego's."""
        return self.agents[ego].world_SE2_agent.inverse() @ self.agents[other].world_SE2_agent

    def matches(self, ego: str, other: str) -> IntArray:
        """(K, 2) pairs of rows, in ego and in other, of detections of the same object, sorted by ego's row."""
        mine, theirs = self.agents[ego].object_id, self.agents[other].object_id
        same = (mine[:, None] == theirs[None, :]) & (mine >= 0)[:, None]
        return np.argwhere(same).astype(np.int64)


class Junction:
    """A simulated junction: a sequence of `ObjectListFrame`.

    Seed and settings determine every frame, in any order of access.

    Attributes:
        seed: integer >= 0.
        settings: of the junction.
        traffic: the vehicles and their paths.

    Raises:
        ValueError: too many vehicles for the junction, or fewer vehicles than agents.
    """

    def __init__(self, seed: int = 0, settings: JunctionSettings | None = None) -> None:
        self.seed = seed
        self.settings = settings = settings or JunctionSettings()
        if settings.vehicles < settings.agents:
            raise ValueError(f"vehicles ({settings.vehicles}) must be at least agents ({settings.agents})")
        rng = np.random.default_rng([seed, _TRAFFIC_STREAM, 0])
        self.traffic = place_traffic(settings.vehicles, settings.agents, settings.duration, rng)

    def __len__(self) -> int:
        """Number of frames."""
        return max(1, round(self.settings.duration * self.settings.rate))

    def __iter__(self) -> Iterator[ObjectListFrame]:
        """The frames in order."""
        return (self[index] for index in range(len(self)))

    def __getitem__(self, index: int) -> ObjectListFrame:
        """The frame with this index, from 0.

        Raises:
            IndexError: index out of range.
        """
        if not -len(self) <= index < len(self):
            raise IndexError(f"frame {index} of a scene of {len(self)}")
        index %= len(self)
        time = index / self.settings.rate
        objects = self.traffic.at(time)
        agents = {}
        for i in range(self.settings.agents):
            rng = np.random.default_rng([self.seed, _FIRST_DETECTION_STREAM + i, index])
            agents[f"car{i + 1}"] = observe(objects, i, self.settings, rng)
        return ObjectListFrame(index=index, time=time, agents=agents, objects=objects)


def observe(objects: Boxes, agent: int | Mast, sensor: SensorSettings, rng: np.random.Generator) -> AgentView:
    """What an agent detects.

    Args:
        objects: true boxes of all vehicles in the world frame at one instant; track_id is the object id, and the row.
        agent: object id of the agent's own vehicle, or a mast, which looks over vehicles.
        sensor: its settings.
        rng: random generator of this agent and frame.
    """
    if isinstance(agent, Mast):
        world_SE2_agent, own_id = agent.world_SE2_mast, -1
        others, body = objects.transform(world_SE2_agent.inverse()), None
        others = others.replace(center=others.center - [0.0, 0.0, agent.height - LIDAR_HEIGHT])
    else:
        world_SE2_agent, own_id = SE2(objects.center[agent, 0], objects.center[agent, 1], objects.yaw[agent]), agent
        in_agent = objects.transform(world_SE2_agent.inverse())
        others, body = in_agent[np.arange(len(objects)) != agent], in_agent[agent].replace(track_id=None)
    # Only what is within range is seen and hides something.
    distance = np.hypot(others.center[:, 0], others.center[:, 1])
    others = others[distance <= sensor.sensor_range + others.size[:, 0]]
    visible = others[is_visible(others, sensor.sensor_range, sensor.min_visible, over_tops=isinstance(agent, Mast))]
    boxes, rows = add_detection_errors(visible, sensor.errors, rng)
    assert visible.track_id is not None
    object_id = np.append(visible.track_id, -1)  # row -1, a false positive, is object -1
    return AgentView(boxes, object_id[rows], visible, world_SE2_agent, own_id, body)
