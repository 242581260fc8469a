"""A drive that several agents see: SUMO traffic on a stored network, every agent's cloud, and the exact truth.

    for scenario in simulated_scenarios("test", count=4, seed=0):
        for frame in scenario:                                # as of any data set
            frame.agents["car1"].points, frame.ground_truth("car1")
        scenario.views(0)["car1"].point_count                 # and how many points lie on each object

The traffic is run once, when a scenario is first used; its frames can then be asked for in any order, and any frame is
the same bytes whatever was asked for before.
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
_STEPS_PER_SECOND = 10  # of the traffic
_NUMBER_STEP = 2  # OPV2V counts simulation steps of 0.05 s
_AGENT_KINDS = ("sedan", "hatchback", "coupe", "suv")
"""What carries a sensor as OPV2V's cars do, 1.9 m above the ground."""
_SPARE_AGENT_KINDS = (*_AGENT_KINDS, "jeep", "pickup", "van", "truck", "bus")
"""What carries one if there are too few of these."""
_AROUND = 50.0
"""Agents are rather those that have many others within this distance [m]."""
_DRAWS = 30


class ScenarioSettings(Settings):
    """What a drive is like.

    Attributes:
        frames: how many.
        rate: frames a second [Hz]; a tenth of a second is a whole number of times between two of them.
        agents: how many vehicles carry a sensor: "car1", "car2", …
        roadside_units: how many sensors stand on masts beside the road: "-1", "-2", …, as in V2XSet.
        lidar: the vehicles' sensor by its name in `LIDARS`; roadside units have the one called "roadside".
        max_distance: agents are at most this far from each other in the middle of the drive [m], if there are such.
        traffic: how much traffic there is.

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
            raise ValueError(f"lidar: no sensor {lidar!r}; there are: {', '.join(LIDARS)}")
        return lidar


class SimulatedScenario(Scenario):
    """The frames of one drive, made when they are asked for. Same network, seed and settings: same bytes.

    As in OPV2V, clouds keep the points on the agent's own body, and an agent's objects are the vehicles, moving and
    parked, that at least one of its points lies on, itself excluded; ids hold for all agents and frames.

    Attributes:
        name: of the scenario.
        network: name of the road network.
        seed: of the world and its traffic, a whole number >= 0.
        settings: what the drive is like.

    Raises:
        ValueError: there is no such network; the message has the nearest one. Or, when first used: not enough vehicles
            can carry a sensor.
        ModuleNotFoundError: when first used: libsumo, embreex or trimesh is not installed.
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
        # What was computed is not pickled: another process makes the same.
        return type(self), (self.network, self.seed, self.settings, self.name)

    @cached_property
    def traffic(self) -> tuple[TrafficSnapshot, ...]:
        """The vehicles of every frame, in the world frame."""
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
        """Who carries the sensor of each agent: a vehicle's id; -1, -2, … for roadside units, which come last.

        The names of vehicles are in the order of their ids as text, so that files named by id are in this order too.
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
        """All that stands still."""
        return World(self.network, self.seed)

    def views(self, index: int) -> dict[str, LidarView]:
        """What every agent sees in a frame, by the agent's name, with the number of points on each object.

        An agent that is not on the network in this frame is left out.

        Raises:
            IndexError: there is no such frame.
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
                # The mount leans the same in all frames.
                mount = np.random.default_rng([self.seed, _MOUNT_STREAM, carrier])
                lidar = LIDARS[settings.lidar]
                sensors.append((now.sensor_on_vehicle(carrier, lidar, mount), carrier))
                lidars.append(lidar)
            else:
                continue
            names.append(name)
        return dict(zip(names, now.views(sensors, lidars, index), strict=True))

    def timestamp(self, index: int) -> str:
        """The name of a frame: OPV2V's numbering by steps of 0.05 s, for 10 Hz."""
        return f"{_NUMBER_STEP * index:06d}"

    @cached_property
    def _masts(self) -> dict[str, FloatArray]:
        """(4, 4) pose of every roadside unit's sensor, by its name."""
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
    """Scenario `number`, from 0, of a split: on the split's networks in turn, each time another world.

    Args:
        split: "train", "validation" or "test".
        number: of the scenario.
        seed: of the whole split.
        settings: what the drive is like.
        network: the network; None for the next of the split.

    Raises:
        ValueError: no such split or network.
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
    """The first `count` scenarios of a split, one after the other: each is large once it was used.

    Args:
        split: "train", "validation" or "test"; no network is in two of them.
        count: how many.
        seed: of the split.
        settings: what the drives are like.

    Raises:
        ValueError: no such split.
    """
    simulated_scenario(split, 0, seed, settings)
    return (simulated_scenario(split, number, seed, settings) for number in range(count))


def split_of(network: str) -> str:
    """The split that a network belongs to.

    Raises:
        ValueError: there is no such network; the message has the nearest one.
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
    """Ids of vehicles that are there in all frames, near each other in the middle of the drive, others around them.

    Where fewer stay, those that stay longest.
    """
    middle = traffic[len(traffic) // 2]
    ids, frames = np.unique(np.concatenate([snapshot.id for snapshot in traffic]), return_counts=True)
    stays = frames[np.searchsorted(ids, middle.id)]
    able = _able(middle, stays, settings.agents)
    xy = np.column_stack([middle.x, middle.y])
    distance = np.hypot(*(xy[:, None] - xy[None]).transpose(2, 0, 1))
    weight = (distance[able] < _AROUND).sum(axis=1).astype(np.float64)
    apart = distance[np.ix_(able, able)]
    draws = [_draw(apart, weight, settings, rng) for _ in range(_DRAWS)]
    widest = [apart[np.ix_(rows, rows)].max() for rows in draws]
    near = next((i for i, width in enumerate(widest) if width <= settings.max_distance), int(np.argmin(widest)))
    chosen: list[int] = middle.id[able[draws[near]]].tolist()
    return chosen


def _able(middle: TrafficSnapshot, stays: IntArray, wanted: int) -> IntArray:
    """Rows of the vehicles to choose from."""
    usual, spare = (np.isin(middle.kind, kinds) for kinds in (_AGENT_KINDS, _SPARE_AGENT_KINDS))
    choices: list[BoolArray] = [kinds & (stays == stays.max()) for kinds in (usual, spare)]
    for choice in choices:
        if choice.sum() >= wanted:
            return np.flatnonzero(choice)
    rows = np.flatnonzero(spare)
    if len(rows) < wanted:
        raise ValueError(f"{wanted} agents wanted, but only {len(rows)} vehicles can carry a sensor")
    longest: IntArray = rows[np.argsort(-stays[rows], kind="stable")[:wanted]]
    return longest


def _draw(apart: FloatArray, weight: FloatArray, settings: ScenarioSettings, rng: np.random.Generator) -> IntArray:
    """Rows of one agent and of others near it, drawn by weight; of any others if too few are near."""
    first = int(rng.choice(len(weight), p=weight / weight.sum()))
    others = np.flatnonzero(apart[first] <= settings.max_distance)
    if len(others) < settings.agents:
        others = np.argsort(apart[first], kind="stable")[: settings.agents]
    others = others[others != first]
    share = weight[others] / max(weight[others].sum(), 1.0)
    more = rng.choice(others, size=settings.agents - 1, replace=False, p=share if len(others) else None)
    rows: IntArray = np.r_[first, more]
    return rows
