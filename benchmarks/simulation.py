"""Speed of simulated drives, without writing: `python benchmarks/simulation.py --processes 2`.

Each process simulates 10 Hz drives of three agents on networks of the test split. Clouds per second count all there is
to do for a drive of `--frames` frames, its world and its traffic included; the table says what each stage takes.
"""

from __future__ import annotations

import argparse
import multiprocessing
import os
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any
from unittest import mock

from cobevglue.simulation import lidar, world
from cobevglue.simulation.scenario import ScenarioSettings, simulated_scenario
from common import print_head

Taken = dict[str, float]
"""Seconds of processor time by stage, of "all", and the number of "clouds"."""

AGENTS = 3
STAGES = ("world", "traffic", "scene of moving vehicles", "rays", "other")


@contextmanager
def timed(taken: Taken, stage: str) -> Iterator[None]:
    """Add the processor's time in a block to a stage [s]."""
    start = time.process_time()
    yield
    taken[stage] += time.process_time() - start


def drive(number: int, frames: int, seed: int) -> Taken:
    """Simulate one drive.

    Returns:
        Seconds of each stage and of all.
    """
    taken: Taken = defaultdict(float)

    def scan(*arguments: Any) -> lidar.Cloud:
        with timed(taken, "rays"):
            return lidar.scan(*arguments)

    def owned(meshes: Any) -> lidar.RayScene:
        with timed(taken, "scene of moving vehicles"):
            return build(meshes)

    build = world._ray_scene
    scenario = simulated_scenario("test", number, seed, ScenarioSettings(frames=frames, agents=AGENTS))
    with timed(taken, "all"):
        with timed(taken, "traffic"):
            carriers = scenario.carriers
        with timed(taken, "world"):
            scenario.world  # noqa: B018
        with mock.patch.object(world, "scan", scan), mock.patch.object(world, "_ray_scene", owned):
            clouds = sum(len(scenario.views(index)) for index in range(frames))
    assert clouds <= frames * len(carriers)
    taken["other"] = taken["all"] - sum(taken[stage] for stage in STAGES)
    taken["clouds"] = clouds
    return taken


def work(first: int, step: int, count: int, frames: int, seed: int, results: Any, start: Any) -> None:
    """One process: drives `first`, `first + step`, …; waits until all are ready to start."""
    start.wait()
    results.put(total([drive(number, frames, seed) for number in range(first, count, step)]))


def total(parts: list[Taken]) -> Taken:
    """The sums."""
    return {key: sum(part[key] for part in parts) for key in ("all", "clouds", *STAGES)}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--drives", type=int, default=10, help="of all processes together")
    parser.add_argument("--frames", type=int, default=80)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    context = multiprocessing.get_context("spawn")
    results, start = context.Queue(), context.Barrier(given.processes + 1)
    share = (given.processes, given.drives, given.frames, given.seed, results, start)
    workers = [context.Process(target=work, args=(first, *share)) for first in range(given.processes)]
    for worker in workers:
        worker.start()
    start.wait()
    began = time.perf_counter()
    taken = total([results.get() for _ in workers])
    seconds = time.perf_counter() - began
    for worker in workers:
        worker.join()
    print_head(f"load {os.getloadavg()[0]:.1f}")
    print(
        f"{given.drives} drives of {given.frames} frames, {AGENTS} agents, {given.processes} processes: "
        f"{taken['clouds']:.0f} clouds in {seconds:.1f} s = {taken['clouds'] / seconds:.1f} clouds/s\n"
    )
    print("| stage | processor time a cloud [ms] | share |")
    print("|---|---|---|")
    for stage in STAGES:
        print(f"| {stage} | {1e3 * taken[stage] / taken['clouds']:.1f} | {100 * taken[stage] / taken['all']:.0f} % |")


if __name__ == "__main__":
    main()
