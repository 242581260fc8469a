"""Simulated scenarios with several agents: SUMO traffic on a stored network, LiDAR clouds and exact ground truth.

    for scenario in simulated_scenarios("test", count=4, seed=0):
        for frame in scenario:                                # as in any data set
            frame.agents["car1"].points, frame.ground_truth("car1")
        scenario.views(0)["car1"].point_count                 # number of points on each object

Traffic is simulated once, on first use. Frames do not depend on the order of access.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from functools import cached_property, lru_cache
from typing import Annotated

import numpy as np
from pydantic import Field, field_validator

from cobevglue.datasets.frame import AgentFrame, Frame, Scenario
from cobevglue.settings import Settings
from cobevglue.simulation.lidar import LIDARS
from cobevglue.simulation.mast_places import mast_places
from cobevglue.simulation.road_network import NETWORKS, network_file
from cobevglue.simulation.traffic import Traffic, TrafficSettings, TrafficSnapshot
from cobevglue.simulation.world import LidarView, World
from cobevglue.typing import BoolArray, FloatArray, IntArray

__all__ = ["ScenarioSettings", "SimulatedScenario", "simulated_scenario", "simulated_scenarios", "split_of"]

_SCENARIO_STREAM, _AGENT_STREAM, _MOUNT_STREAM = 60, 61, 62
_STEPS_PER_SECOND = 10  # of the traffic simulation
_NUMBER_STEP = 2  # OPV2V numbers frames by simulation steps of 0.05 s
_AGENT_KINDS = ("sedan", "hatchback", "coupe", "suv")
"""Kinds of vehicle that carry a sensor, 1.9 m above the ground as in OPV2V."""
_SPARE_AGENT_KINDS = (*_AGENT_KINDS, "jeep", "pickup", "van", "truck", "bus")
"""Kinds used if too few of these stay for the whole scenario."""
_NEIGHBOUR_RADIUS = 50.0
"""Agents are drawn in proportion to the number of vehicles within this distance [m]."""
_DRAWS = 30


class ScenarioSettings(Settings):
    """Settings of a simulated scenario.

    Attributes:
        frames: number of frames.
        rate: frame rate [Hz]; 1 / rate is a multiple of 0.1 s.
        agents: number of vehicles with a sensor: "car1", "car2", …
        roadside_units: number of sensors on masts beside the road: "-1", "-2", …, as in V2XSet.
        lidar: name of the vehicles' sensor in `LIDARS`; roadside units use "roadside".
        max_distance: maximum distance between agents in the middle frame [m], where possible.
        traffic: settings of the traffic.

    Raises:
        ValueError: a value out of its range, or an unknown field.
    """

    frames: Annotated[int, Field(ge=1, le=9999)] = 80
    rate: Annotated[float, Field(gt=0.0, le=10.0)] = 10.0
    agents: Annotated[int, Field(ge=1, le=8)] = 2
    roadside_units: Annotated[int, Field(ge=0, le=4)] = 0
    lidar: str = "opv2v"
    max_distance: Annotated[float, Field(gt=0.0)] = 70.0
    traffic: TrafficSettings = TrafficSettings()

    @field_validator("rate")
    @classmethod
    def _whole_steps(cls, rate: float) -> float:
        steps = _STEPS_PER_SECOND / rate
        if abs(steps - round(steps)) > 1e-6:
            raise ValueError(f"rate: 1/rate must be a multiple of 0.1 s, got {rate} Hz")
        return rate

    @field_validator("lidar")
    @classmethod
    def _known_lidar(cls, lidar: str) -> str:
        if lidar not in LIDARS:
            raise ValueError(f"lidar: no sensor {lidar!r}; known: {', '.join(LIDARS)}")
        return lidar


class SimulatedScenario(Scenario):
    """One simulated scenario; frames are computed on access and determined by network, seed and settings.

    As in OPV2V, clouds contain the points on the agent's own body, and an agent's objects are the moving and parked
    vehicles with at least one of its points, itself excluded; ids are the same for all agents and frames.

    Attributes:
        name: of the scenario.
        network: name of the road network.
        seed: of the world and its traffic, an integer >= 0.
        settings: of the scenario.

    Raises:
        ValueError: unknown network; the message suggests the nearest one. On first use: too few vehicles can carry a
            sensor.
        ModuleNotFoundError: on first use: libsumo, embreex or trimesh is not installed.
    """

    def __init__(
        self, network: str, seed: int = 0, settings: ScenarioSettings | None = None, name: str | None = None
    ) -> None:
        network_file(network)
        if seed < 0:
            raise ValueError(f"seed must be >= 0, got {seed}")
        self.network, self.seed, self.settings = network, seed, settings or ScenarioSettings()
        super().__init__(name or f"{network}_{seed}", self.settings.frames, self._frame)

    def __reduce__(self) -> tuple[type[SimulatedScenario], tuple[str, int, ScenarioSettings, str]]:
        # Cached results are not pickled: other processes recompute them.
        return type(self), (self.network, self.seed, self.settings, self.name)

    @cached_property
    def traffic(self) -> tuple[TrafficSnapshot, ...]:
        """Vehicles of every frame, in the world frame."""
        settings = self.settings
        snapshots = []
        with Traffic(self.network, self.seed, settings.traffic) as traffic:
            for index in range(settings.frames):
                if index:
                    traffic.step(1.0 / settings.rate)
                snapshots.append(traffic.vehicles())
        return tuple(snapshots)

    @cached_property
    def carriers(self) -> dict[str, int]:
        """Vehicle id of each agent by name; -1, -2, … for roadside units, which are last.

        Agents are numbered in the order of their vehicle ids as strings, which is the order of folders named by id.
        """
        rng = np.random.default_rng([self.seed, _AGENT_STREAM, 0])
        try:
            vehicles = _choose_agents(self.traffic, self.settings, rng)
        except ValueError as error:
            raise ValueError(f"{self.name}: {error}") from None
        names = {f"car{number}": vehicle for number, vehicle in enumerate(sorted(vehicles, key=str), start=1)}
        return names | {f"-{number}": -number for number in range(1, self.settings.roadside_units + 1)}

    @cached_property
    def world(self) -> World:
        """The static world."""
        return World(self.network, self.seed)

    def views(self, index: int) -> dict[str, LidarView]:
        """Views of a frame by agent name, without agents that are not on the network in this frame.

        Raises:
            IndexError: index out of range.
        """
        settings, snapshot = self.settings, self.traffic[index]
        index = range(len(self))[index]
        now = self.world.at(snapshot)
        names, sensors, lidars = [], [], []
        for name, carrier in self.carriers.items():
            if carrier < 0:
                sensors.append((self._masts[name], -1))
                lidars.append(LIDARS["roadside"])
            elif carrier in snapshot.id:
                # The mount has the same tilt in all frames.
                mount = np.random.default_rng([self.seed, _MOUNT_STREAM, carrier])
                lidar = LIDARS[settings.lidar]
                sensors.append((now.sensor_on_vehicle(carrier, lidar, mount), carrier))
                lidars.append(lidar)
            else:
                continue
            names.append(name)
        return dict(zip(names, now.views(sensors, lidars, index), strict=True))

    def timestamp(self, index: int) -> str:
        """Name of a frame in OPV2V's numbering by steps of 0.05 s, for 10 Hz."""
        return f"{_NUMBER_STEP * index:06d}"

    @cached_property
    def _masts(self) -> dict[str, FloatArray]:
        """(4, 4) sensor pose of each roadside unit by name."""
        middle = self.traffic[len(self) // 2]
        xy = np.column_stack([middle.x, middle.y])
        agents = xy[np.isin(middle.id, list(self.carriers.values()))]
        places = mast_places(self.world, agents.mean(axis=0), self.settings.roadside_units, LIDARS["roadside"])
        return {f"-{number}": pose for number, pose in enumerate(places, start=1)}

    def _frame(self, index: int) -> Frame:
        snapshot = self.traffic[index]
        views = lru_cache(maxsize=1)(lambda: self.views(index))
        return Frame(
            scenario=self.name,
            timestamp=self.timestamp(index),
            time=index / self.settings.rate,
            agents={
                name: _agent_frame(views, name, carrier < 0)
                for name, carrier in self.carriers.items()
                if carrier < 0 or carrier in snapshot.id
            },
        )


def simulated_scenario(
    split: str, number: int, seed: int = 0, settings: ScenarioSettings | None = None, network: str | None = None
) -> SimulatedScenario:
    """Scenario `number` of a split: its networks are used in turn, each time with a new world.

    Args:
        split: "train", "validation" or "test".
        number: index of the scenario, from 0.
        seed: of the split.
        settings: of the scenario.
        network: name of the network; None for the split's networks in turn.

    Raises:
        ValueError: unknown split or network.
    """
    if split not in NETWORKS:
        raise ValueError(f"split must be one of {', '.join(NETWORKS)}, got {split!r}")
    stream = _SCENARIO_STREAM + 10 * tuple(NETWORKS).index(split)
    rng = np.random.default_rng([seed, stream, number])
    network = network or NETWORKS[split][(number + seed) % len(NETWORKS[split])]
    return SimulatedScenario(network, int(rng.integers(2**31)), settings, f"{number:03d}_{network}")


def simulated_scenarios(
    split: str, count: int, seed: int = 0, settings: ScenarioSettings | None = None
) -> Iterator[SimulatedScenario]:
    """Iterate over the first `count` scenarios of a split; each caches its world and traffic once used.

    Args:
        split: "train", "validation" or "test"; their networks are disjoint.
        count: number of scenarios.
        seed: of the split.
        settings: of the scenarios.

    Raises:
        ValueError: unknown split.
    """
    simulated_scenario(split, 0, seed, settings)
    return (simulated_scenario(split, number, seed, settings) for number in range(count))


def split_of(network: str) -> str:
    """The split of a network.

    Raises:
        ValueError: unknown network; the message suggests the nearest one.
    """
    network_file(network)
    return next(split for split, names in NETWORKS.items() if network in names)


def _agent_frame(views: Callable[[], Mapping[str, LidarView]], name: str, is_infrastructure: bool) -> AgentFrame:
    return AgentFrame(
        read_labels=lambda: (views()[name].world_SE3_lidar, views()[name].boxes),
        read_points=lambda: views()[name].points,
        is_infrastructure=is_infrastructure,
    )


def _choose_agents(
    traffic: Sequence[TrafficSnapshot], settings: ScenarioSettings, rng: np.random.Generator
) -> list[int]:
    """Ids of vehicles present in all frames, near each other and with many neighbours in the middle frame.

    If too few are, the vehicles present in most frames.
    """
    middle = traffic[len(traffic) // 2]
    ids, frames = np.unique(np.concatenate([snapshot.id for snapshot in traffic]), return_counts=True)
    presence = frames[np.searchsorted(ids, middle.id)]
    eligible = _eligible(middle, presence, settings.agents)
    xy = np.column_stack([middle.x, middle.y])
    distance = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
    weight = (distance[eligible] < _NEIGHBOUR_RADIUS).sum(axis=1).astype(np.float64)
    apart = distance[np.ix_(eligible, eligible)]
    draws = [_draw(apart, weight, settings, rng) for _ in range(_DRAWS)]
    widest = [apart[np.ix_(rows, rows)].max() for rows in draws]
    near = next((i for i, width in enumerate(widest) if width <= settings.max_distance), int(np.argmin(widest)))
    chosen: list[int] = middle.id[eligible[draws[near]]].tolist()
    return chosen


def _eligible(middle: TrafficSnapshot, presence: IntArray, count: int) -> IntArray:
    """Rows of the vehicles that can be agents; `presence` is the number of frames of each."""
    usual, spare = (np.isin(middle.kind, kinds) for kinds in (_AGENT_KINDS, _SPARE_AGENT_KINDS))
    choices: list[BoolArray] = [kinds & (presence == presence.max()) for kinds in (usual, spare)]
    for choice in choices:
        if choice.sum() >= count:
            return np.flatnonzero(choice)
    rows = np.flatnonzero(spare)
    if len(rows) < count:
        raise ValueError(f"{count} agents requested, but only {len(rows)} vehicles can carry a sensor")
    longest: IntArray = rows[np.argsort(-presence[rows], kind="stable")[:count]]
    return longest


def _draw(apart: FloatArray, weight: FloatArray, settings: ScenarioSettings, rng: np.random.Generator) -> IntArray:
    """Rows of one agent and of others near it, drawn by weight; the nearest ones if too few are within range."""
    first = int(rng.choice(len(weight), p=weight / weight.sum()))
    others = np.flatnonzero(apart[first] <= settings.max_distance)
    if len(others) < settings.agents:
        others = np.argsort(apart[first], kind="stable")[: settings.agents]
    others = others[others != first]
    share = weight[others] / max(weight[others].sum(), 1.0)
    more = rng.choice(others, size=settings.agents - 1, replace=False, p=share if len(others) else None)
    rows: IntArray = np.r_[first, more]
    return rows
