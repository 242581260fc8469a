"""Scenes of traffic seen by two agents, one file each: what `SCENES` names is made from a random generator.

Vehicles drive on scripted paths without touching each other; the same random numbers give the same scene.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cobevglue.simulation.object_scenes.car_park import car_park
from cobevglue.simulation.object_scenes.junction import junction
from cobevglue.simulation.object_scenes.mast import mast_over_queue
from cobevglue.simulation.object_scenes.motorway import motorway
from cobevglue.simulation.object_scenes.roundabout import roundabout
from cobevglue.simulation.object_scenes.scene import Mast, Scene

__all__ = ["SCENES", "Mast", "Scene"]

SCENES: dict[str, Callable[[np.random.Generator, float], Scene]] = {
    "motorway": motorway,
    "junction": junction,
    "roundabout": roundabout,
    "car park": car_park,
    "mast": mast_over_queue,
}
"""From the name of a scene to the function that makes one, with two agents, from a generator and its duration [s]."""
