"""Scenes of traffic seen by two agents, one file each: what `SCENES` names is made from a random generator.

Vehicles drive on scripted paths without touching each other; the same random numbers give the same scene.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from cobevglue.simulation.object_scenes.car_park import car_park_scene
from cobevglue.simulation.object_scenes.junction import junction_scene
from cobevglue.simulation.object_scenes.mast import mast_scene
from cobevglue.simulation.object_scenes.motorway import motorway_scene
from cobevglue.simulation.object_scenes.roundabout import roundabout_scene
from cobevglue.simulation.object_scenes.scene import Mast, Scene

__all__ = ["SCENES", "Mast", "Scene"]

SCENES: dict[str, Callable[[np.random.Generator, float], Scene]] = {
    "motorway": motorway_scene,
    "junction": junction_scene,
    "roundabout": roundabout_scene,
    "car park": car_park_scene,
    "mast": mast_scene,
}
"""From the name of a scene to the function that makes one, with two agents, from a generator and its duration [s]."""
