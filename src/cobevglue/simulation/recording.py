"""A simulated drive as a ROS 2 bag, as a fleet would record it: each vehicle has its own instants and its own delay."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from cobevglue.datasets.whole_files import errors_name
from cobevglue.recordings.writer import new_detection_bag
from cobevglue.simulation.object_lists import Junction, JunctionSettings, observe

__all__ = ["STAGGER", "START", "write_recording"]

START = 1_700_000_000.0
"""Time stamp of the first list [s], as the clocks of recorders have it."""
STAGGER = 0.03
"""The lists of each vehicle are so much later than those of the one before [s]."""
_DELAY = 0.05
"""From the instant of a list to its receipt [s]."""
_DETECTION_STREAM = 60
"""First random stream of the detections, one for each vehicle."""


def write_recording(folder: str | Path, seed: int, frames: int, agents: int) -> dict[str, int]:
    """Record the objects that several vehicles detect at a simulated junction.

    The topic of a vehicle is `/car1/objects` and so on, with `vision_msgs/Detection3DArray` at 10 Hz.

    Args:
        folder: of the bag; must not exist.
        seed: of traffic and detection errors.
        frames: number of lists of each vehicle.
        agents: number of vehicles, 1 to 8.

    Returns:
        Number of lists by topic.

    Raises:
        ValueError: too many vehicles.
        FileExistsError: the folder exists.
        OSError: it cannot be written.
        ModuleNotFoundError: rosbags is not installed.
    """
    settings = JunctionSettings(agents=agents, duration=frames / 10.0)
    traffic = Junction(seed, settings).traffic
    counts = {f"/car{agent + 1}/objects": 0 for agent in range(agents)}
    with errors_name(Path(folder)), new_detection_bag(folder) as bag:
        for index in range(frames):
            for agent, topic in enumerate(counts):
                time = index / settings.rate + STAGGER * agent
                rng = np.random.default_rng([seed, _DETECTION_STREAM + agent, index])
                boxes = observe(traffic.at(time), agent, settings, rng).boxes
                bag.write(topic, START + time + _DELAY, START + time, f"car{agent + 1}", boxes)
                counts[topic] += 1
    return counts
