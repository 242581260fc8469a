"""Run time of perception, from a stored point cloud to tracked boxes."""

from __future__ import annotations

import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

import numpy as np

__all__ = ["CLOUDS", "measure_perception"]

CLOUDS = 20
"""Number of timed clouds, after `_WARM_UP` clouds that are not timed."""
_WARM_UP = 3
_NETWORK, _SEED = "junction_test_0", 0


def measure_perception(weights: str, threads: int) -> dict[str, Any] | None:
    """Measure every stage of perception on simulated clouds of OPV2V's sensor.

    Args:
        weights: of the detector, a shipped name or a .safetensors file. It runs on CUDA if available.
        threads: number of torch's threads.

    Returns:
        JSON-serialisable: `stages[stage]` with `median_ms` and `best_ms`; mean number of points per cloud, weights,
        device, threads, and peak memory of this process so far [MB]. None if torch or the simulation is not installed.

    Raises:
        ValueError: unknown or damaged weights.
        FileNotFoundError: the file of weights does not exist.
    """
    try:
        import torch  # noqa: F401  # raises the ModuleNotFoundError that is handled below

        from cobevglue.datasets.opv2v_writer import write_opv2v_frame
        from cobevglue.datasets.pcd import read_pcd
        from cobevglue.perception import Perception, PointPillars
        from cobevglue.simulation.episodes import EpisodeSettings, SimulatedEpisodes
        from cobevglue.torch_device import chosen_device
        from cobevglue.torch_threads import torch_threads

        detector = PointPillars.named(weights).to(chosen_device())
        snapshots = EpisodeSettings(snapshots=4, agents=5, vary_sensor=False)
        clouds = SimulatedEpisodes("test", _SEED, snapshots).episode(0)
    except ModuleNotFoundError:
        return None
    perception = Perception(detector)
    taken: list[dict[str, float]] = []
    with torch_threads(threads), tempfile.TemporaryDirectory() as folder:
        for number, cloud in enumerate(clouds):
            write_opv2v_frame(Path(folder), f"{number:06d}", np.eye(4), cloud.boxes, cloud.points)
        for number in range(CLOUDS + _WARM_UP):
            file = Path(folder) / f"{number % len(clouds):06d}.pcd"
            start = time.perf_counter()
            points = read_pcd(file)
            loaded = time.perf_counter()
            stages = perception.step(points).seconds
            taken.append({"load": loaded - start, **stages, "all": time.perf_counter() - start})
    timed = taken[_WARM_UP:]
    return {
        "stages": {
            stage: {
                "median_ms": 1e3 * statistics.median(one[stage] for one in timed),
                "best_ms": 1e3 * min(one[stage] for one in timed),
            }
            for stage in timed[0]
        },
        "points": round(statistics.mean(len(cloud.points) for cloud in clouds)),
        "weights": weights,
        "device": str(detector.device),
        "threads": threads,
        "largest_memory_mb": _largest_memory(),
    }


def _largest_memory() -> float | None:
    try:
        import resource
    except ModuleNotFoundError:  # Windows
        return None
    import sys

    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return largest / (1024**2 if sys.platform == "darwin" else 1024)
