"""`cobevglue simulate`: simulated scenarios of several agents as a data set of clouds and labels."""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import Enum
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated, Any

import typer

from cobevglue.cli.errors import InputError, expected_errors
from cobevglue.cli.output import print_json

__all__ = ["Format", "LidarName", "Split", "simulate"]


class Format(str, Enum):
    """On-disk formats that can be written."""

    OPV2V = "opv2v"
    V2V4REAL = "v2v4real"
    DAIR_V2X = "dair-v2x"
    MCAP = "mcap"


class Split(str, Enum):
    """Splits; their road networks are disjoint."""

    TRAIN = "train"
    VALIDATION = "validation"
    TEST = "test"


class LidarName(str, Enum):
    """LiDAR sensors of vehicles."""

    OPV2V = "opv2v"
    BEAMS32 = "beams32"
    BEAMS16 = "beams16"


def simulate(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="Root of the data set; created if missing.")],
    kind: Annotated[Format, typer.Option("--format", help="Layout of the files.")] = Format.OPV2V,
    split: Annotated[
        Split | None,
        typer.Option(help="Split of the road networks, and name of the folder; default: that of --network, or test."),
    ] = None,
    scenarios: Annotated[int, typer.Option(min=1, max=1000, help="Number of scenarios.")] = 1,
    frames: Annotated[int, typer.Option(min=1, max=9999, help="Frames per scenario, at 10 Hz.")] = 80,
    agents: Annotated[
        int | None, typer.Option(min=1, max=8, help="Vehicles with a LiDAR; default: that of the format, or 2.")
    ] = None,
    roadside_units: Annotated[
        int | None, typer.Option(min=0, max=4, help="Roadside LiDARs; default: that of the format, or 0.")
    ] = None,
    lidar: Annotated[LidarName, typer.Option(help="LiDAR sensor of the vehicles.")] = LidarName.OPV2V,
    network: Annotated[
        str | None, typer.Option(help="Name of the road network; default: all of the split in turn.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of worlds and traffic.")] = 0,
    labels_only: Annotated[bool, typer.Option("--labels-only", help="Do not write point clouds.")] = False,
    workers: Annotated[int | None, typer.Option(min=1, help="Number of processes; default: number of cores.")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Simulate several vehicles with LiDARs in traffic, and write a data set.

    Traffic is simulated by SUMO on stored road networks. Labels are exact: vehicles with at least one point, and their
    numbers of points. --format v2v4real has two vehicles, dair-v2x one vehicle and a roadside unit. The same options
    give the same files, and the same command resumes an interrupted run.

    --format mcap writes a ROS 2 bag with object lists of vehicles at a junction, for `cobevglue replay`:
    detections with errors, without clouds, of different instants. Only --frames, --agents and --seed apply to it.

    Needs: pip install 'cobevglue[simulation]', and 'cobevglue[ros]' for mcap
    """
    if kind is Format.MCAP:
        _refuse_given(
            {
                "--split": split is not None,
                "--network": network is not None,
                "--roadside-units": roadside_units is not None,
                "--scenarios": scenarios != 1,
                "--lidar": lidar is not LidarName.OPV2V,
                "--labels-only": labels_only,
                "--workers": workers is not None,
            }
        )
        _write_bag(out, frames, agents or 2, seed, as_json)
        return
    _require_extra()
    from cobevglue.simulation.export import export
    from cobevglue.simulation.layouts import LAYOUTS, Task
    from cobevglue.simulation.scenario import ScenarioSettings, simulated_scenario, split_of

    with expected_errors():
        name = _split_name(split, None if network is None else split_of(network), network)
        layout = LAYOUTS[kind.value](out, name, labels_only)
        settings = ScenarioSettings(
            frames=frames,
            agents=agents or layout.agents or 2,
            roadside_units=(layout.roadside_units or 0) if roadside_units is None else roadside_units,
            lidar=lidar.value,
        )
        tasks = [Task(i, simulated_scenario(name, i, seed, settings, network)) for i in range(scenarios)]
        started = time.perf_counter()
        with _progress_bar() as progress:
            report = export(layout, tasks, workers=workers or os.cpu_count() or 1, progress=progress)
        seconds = time.perf_counter() - started
    document: dict[str, Any] = {
        "root": str(out),
        "format": kind.value,
        "split": name,
        "scenarios": [{"name": task.scenario.name, "folder": str(layout.scenario_folder(task))} for task in tasks],
        "agents": settings.agents,
        "roadside_units": settings.roadside_units,
        "frames_written": report.frames_written,
        "frames_kept": report.frames_kept,
        "seconds": seconds,
    }
    if as_json:
        print_json(document)
    else:
        print(
            f"{out}: {scenarios} x {frames} frames of {settings.agents + settings.roadside_units} agents, "
            f"{report.frames_written} written, {report.frames_kept} existed already"
        )


def _refuse_given(options: dict[str, bool]) -> None:
    """An error for options that were given although they say nothing about object lists."""
    for option, given in options.items():
        if given:
            raise InputError(f"{option}: not for --format mcap")


def _write_bag(out: Path, frames: int, agents: int, seed: int, as_json: bool) -> None:
    if find_spec("rosbags") is None:
        raise InputError("--format mcap needs rosbags: pip install 'cobevglue[ros]'")
    from cobevglue.simulation.recording import write_recording

    with expected_errors():
        topics = write_recording(out, seed, frames, agents)
    if as_json:
        print_json({"root": str(out), "format": Format.MCAP.value, "topics": topics})
    else:
        print(f"{out}: a ROS 2 bag with {frames} lists on each of {', '.join(topics)}")


def _require_extra() -> None:
    missing = [module for module in ("libsumo", "embreex", "trimesh") if find_spec(module) is None]
    if missing:
        raise InputError(f"simulation needs {', '.join(missing)}: pip install 'cobevglue[simulation]'")


def _split_name(split: Split | None, of_network: str | None, network: str | None) -> str:
    if split is not None and of_network not in (None, split.value):
        raise InputError(f"--network: {network} is of the split {of_network!r}, not {split.value!r}")
    return of_network or (split or Split.TEST).value


@contextmanager
def _progress_bar() -> Iterator[Callable[[int, int], None]]:
    """Progress bar on standard error; yields a function of the numbers of completed and of all frames."""
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

    columns = (TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    bar = Progress(*columns, console=Console(stderr=True))
    task = bar.add_task("frames", total=None)

    def show(done: int, total: int) -> None:
        bar.start()  # with the first frame, so that early errors are printed without a bar
        bar.update(task, completed=done, total=total)

    try:
        yield show
    finally:
        if bar.live.is_started:
            bar.stop()
