"""What every scene is: vehicles on scripted paths, and the agents among or above them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from cobevglue.se2 import SE2
from cobevglue.simulation.scripted_traffic import Traffic

__all__ = ["Mast", "Scene"]


@dataclass(frozen=True, slots=True)
class Mast:
    """A roadside unit: a sensor at a fixed place that looks over vehicles and is no object itself.

    Attributes:
        world_SE2_mast: its pose.
        height: of the sensor above the ground [m].
    """

    world_SE2_mast: SE2
    height: float


@dataclass(frozen=True, slots=True)
class Scene:
    """Traffic and agents.

    Attributes:
        traffic: all vehicles.
        agents: by name, the object id of an agent's own vehicle, or a mast.
    """

    traffic: Traffic
    agents: dict[str, int | Mast]

    def pose(self, agent: str, time: float) -> SE2:
        """`world_SE2_agent` at `time` [s]: of a vehicle's LiDAR above its centre, or of the mast."""
        carrier = self.agents[agent]
        if isinstance(carrier, Mast):
            return carrier.world_SE2_mast
        x, y, yaw = self.traffic.vehicles[carrier].pose(np.array([time]))[0]
        return SE2(x, y, yaw)
