"""Simulated clouds for training and testing a detector: a few snapshots of each of many worlds."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np
from pydantic import Field

from cobevglue.boxes import Boxes
from cobevglue.datasets.labelled_cloud import LabelledCloud
from cobevglue.settings import Settings
from cobevglue.simulation.lidar import LIDARS, LidarSettings
from cobevglue.simulation.road_network import NETWORKS
from cobevglue.simulation.traffic import Traffic
from cobevglue.simulation.world import LidarView, World

__all__ = ["EpisodeSettings", "SimulatedEpisodes"]

_EPISODE_STREAM = 30
_AGENT_KINDS = ("sedan", "hatchback", "coupe", "suv")
"""Kinds of vehicle that can carry a sensor: their roofs are below its height of 1.9 m."""


class EpisodeSettings(Settings):
    """Settings of an episode.

    Attributes:
        snapshots: number of snapshots of a world.
        agents: number of agents in each snapshot.
        interval: mean time between snapshots [s].
        lidars: names of sensors in `LIDARS` and their weights.
        vary_sensor: randomise drop-outs, noise and height per episode, against overfitting to one sensor.
        keep_own_points: share of clouds that keep the points on the agent's own body.
    """

    snapshots: Annotated[int, Field(ge=1, le=1000)] = 4
    agents: Annotated[int, Field(ge=1, le=100)] = 5
    interval: Annotated[float, Field(gt=0.0, le=60.0)] = 6.0
    lidars: dict[str, float] = Field(default={"opv2v": 1.0})
    vary_sensor: bool = True
    keep_own_points: Annotated[float, Field(ge=0.0, le=1.0)] = 0.4


@dataclass(frozen=True)
class SimulatedEpisodes:
    """Episodes of one split, determined by split, seed and settings.

    Attributes:
        split: "train", "validation" or "test"; their networks and random streams are disjoint.
        seed: integer >= 0.
        settings: of an episode.

    Raises:
        ValueError: an unknown split or sensor.
    """

    split: str
    seed: int = 0
    settings: EpisodeSettings = field(default_factory=EpisodeSettings)

    def __post_init__(self) -> None:
        if self.split not in NETWORKS:
            raise ValueError(f"split must be one of {', '.join(NETWORKS)}, got {self.split!r}")
        for name in self.settings.lidars:
            if name not in LIDARS:
                raise ValueError(f"lidars: no sensor {name!r}; known: {', '.join(LIDARS)}")

    def episode(self, index: int) -> list[LabelledCloud]:
        """Up to `snapshots` x `agents` clouds of one world; fewer if too few vehicles can carry a sensor."""
        networks = NETWORKS[self.split]
        rng = np.random.default_rng([self.seed, _EPISODE_STREAM + tuple(NETWORKS).index(self.split), index])
        world_seed = int(rng.integers(2**31))
        network = networks[(index + self.seed) % len(networks)]
        world = World(network, world_seed)
        names = list(self.settings.lidars)
        shares = np.array([self.settings.lidars[name] for name in names])
        lidar = LIDARS[names[rng.choice(len(names), p=shares / shares.sum())]]
        if self.settings.vary_sensor:
            lidar = _varied(lidar, rng)
        clouds = []
        with Traffic(network, world_seed) as traffic:
            for snapshot in range(self.settings.snapshots):
                traffic.step(round(float(rng.uniform(0.5, 1.5)) * self.settings.interval, 1))
                now = world.at(traffic.vehicles())
                agents = _choose_agents(now.moving, self.settings.agents, rng)
                sensors = [(now.sensor_on_vehicle(agent, lidar, rng), agent) for agent in agents]
                views = now.views(sensors, [lidar] * len(sensors), snapshot)
                clouds += [_labelled(view, rng.random() < self.settings.keep_own_points) for view in views]
        return clouds


def _varied(lidar: LidarSettings, rng: np.random.Generator) -> LidarSettings:
    return lidar.model_copy(
        update={
            "dropout": float(np.clip(lidar.dropout * rng.uniform(0.3, 2.5), 0.0, 0.6)),
            "range_noise": float(lidar.range_noise * rng.uniform(0.5, 1.5)),
            "height": float(lidar.height + rng.uniform(-0.15, 0.25)),
            "shots": int(lidar.shots * rng.uniform(0.9, 1.15)),
        }
    )


def _choose_agents(vehicles: Boxes, count: int, rng: np.random.Generator) -> list[int]:
    """Ids of up to `count` vehicles that can carry a sensor, drawn in proportion to their number of neighbours."""
    assert vehicles.track_id is not None
    assert vehicles.label is not None
    eligible = np.flatnonzero(np.isin(vehicles.label, _AGENT_KINDS))
    if not len(eligible):
        return []
    xy = vehicles.center[:, :2]
    neighbours = (np.hypot(*(xy[eligible, None] - xy[None]).transpose(2, 0, 1)) < 50.0).sum(axis=1)
    weight = neighbours / neighbours.sum()
    chosen = rng.choice(eligible, size=min(count, len(eligible)), replace=False, p=weight)
    ids: list[int] = vehicles.track_id[chosen].tolist()
    return ids


def _labelled(view: LidarView, keep_own: bool) -> LabelledCloud:
    points = view.points if keep_own else view.points[~view.own]
    return LabelledCloud(points, view.boxes, view.point_count)
