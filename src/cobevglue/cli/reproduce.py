"""`cobevglue reproduce`: the paper's tables and figures on any data set."""

from __future__ import annotations

import os
import platform
import shlex
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib.metadata import distributions
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from cobevglue.cli.dataset_options import DatasetOptions, parse_dataset_options
from cobevglue.cli.errors import InputError, expected_errors
from cobevglue.cli.output import print_json, print_note, print_table

if TYPE_CHECKING:
    from cobevglue.experiments.study import StudySettings

__all__ = ["reproduce"]

_PACKAGES = ("cobevglue", "torch", "numpy", "scipy", "numba", "libsumo", "open3d-cpu", "small-gicp", "ray")
_QUICK_SEQUENCES, _QUICK_FRAMES = 2, 6
_REAL_SPLIT = "test_culvercity"


def reproduce(
    context: typer.Context,
    quick: Annotated[
        bool, typer.Option("--quick", help="Minutes instead of an hour: fewer sequences, frames and conditions.")
    ] = False,
    dataset: Annotated[str, typer.Option(help="simulated, opv2v, v2xset, v2v4real or dair-v2x.")] = "simulated",
    root: Annotated[Path | None, typer.Option(help="Root of the data set; not for simulated.")] = None,
    split: Annotated[str, typer.Option(help="Name of the split.")] = "test",
    real: Annotated[
        Path | None, typer.Option(help="Root of OPV2V; its split test_culvercity is reported, too.")
    ] = None,
    dataset_option: DatasetOptions = None,
    out: Annotated[Path, typer.Option(help="Folder of the report; an interrupted run is resumed in it.")] = Path(
        "report"
    ),
    tables: Annotated[
        str | None,
        typer.Option(
            help="Only these, separated by commas: noise, attack, registration, ablation, disturbances, pose, "
            "communication, bandwidth, time."
        ),
    ] = None,
    methods: Annotated[
        str | None, typer.Option(help="Only these fusion methods, separated by commas, besides none and cobevglue.")
    ] = None,
    scenarios: Annotated[
        int | None, typer.Option(min=1, help="Maximum number of sequences; default: all, or 20 simulated ones.")
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option(min=1, help="Maximum number of frames per sequence; default: all, or 20 of simulated ones."),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of simulated sequences and of all disturbances.")
    ] = None,
    detector: Annotated[str, typer.Option(help="Name of shipped weights, or a .safetensors file.")] = "compact",
    weights: Annotated[
        Path | None, typer.Option(help="Folder with weights of the fusion methods, NAME.safetensors.")
    ] = None,
    untrained: Annotated[
        bool, typer.Option("--untrained", help="Use fusion methods without trained weights, for tests.")
    ] = False,
    workers: Annotated[int | None, typer.Option(min=1, help="Number of processes; default: number of cores.")] = None,
    use_ray: Annotated[
        bool, typer.Option("--ray", help="Use the Ray cluster at RAY_ADDRESS, or a local one of --workers processes.")
    ] = False,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Reproduce the paper's tables and figures on simulated sequences or on a data set.

    Every fusion method under localisation noise and attack, point cloud registration, ablation, other disturbances,
    pose accuracy, communication volume, average precision over bandwidth, and run time. Writes index.html, report.md
    and CSV files; for a data set of the paper, the published numbers are shown, too.

    Results are stored in the folder: the same command resumes an interrupted run, and with other --tables computes only
    missing results.
    """
    start = time.perf_counter()
    try:
        from cobevglue.experiments.reproduce import reproduce as run
        from cobevglue.experiments.study import SEED, StudySettings
        from cobevglue.experiments.tables import EXPERIMENTS, FULL, QUICK, experiments_named
        from cobevglue.fusion import fusion_class
    except ImportError as error:
        raise InputError(" ".join(str(error).split())) from error
    options = parse_dataset_options(dataset_option)
    names = list(EXPERIMENTS) if tables is None else [name.strip() for name in tables.split(",")]
    common: dict[str, Any] = {
        "scenarios": scenarios or (_QUICK_SEQUENCES if quick else None),
        "frames": frames or (_QUICK_FRAMES if quick else None),
        "seed": SEED if seed is None else seed,
        "detector": detector,
        "weights": None if weights is None else str(weights),
        "untrained": untrained,
    }
    studies = [
        StudySettings(dataset=dataset, root=None if root is None else str(root), split=split, reader=options, **common)
    ]
    if real is not None:
        # Sequences without clouds are skipped, so the number of sequences is not limited.
        studies.append(
            StudySettings(dataset="opv2v", root=str(real), split=_REAL_SPLIT, **{**common, "scenarios": None})
        )
    try:
        with expected_errors(), _progress_bar() as progress:
            only = None if methods is None else [name.strip() for name in methods.split(",")]
            for name in only or ():
                fusion_class(name)
            made = run(
                studies,
                experiments_named(names),
                replace(QUICK if quick else FULL, only=only),
                out,
                _about(context, studies),
                workers=workers or os.cpu_count() or 1,
                use_ray=use_ray,
                progress=progress,
            )
    except ModuleNotFoundError as error:
        raise InputError(" ".join(str(error).split())) from error
    minutes = (time.perf_counter() - start) / 60.0
    if as_json:
        print_json(
            {
                "page": str(out / "index.html"),
                "minutes": minutes,
                "studies": [study.model_dump(mode="json") for study in studies],
                "tables": {
                    label or "summary": [
                        {"name": table.name, "title": table.title, "columns": list(table.columns), "rows": table.rows}
                        for table in each
                    ]
                    for label, each in made.items()
                },
            }
        )
        return
    (summary,) = made[""]
    print_table(summary.title, summary.columns, summary.text_rows())
    print(f"Open {out / 'index.html'} for the full report ({minutes:.1f} minutes).")


def _about(context: typer.Context, studies: Sequence[StudySettings]) -> list[str]:
    """Command, seed, versions, machine and date, one line each."""
    from cobevglue.cli.measure import processor_name

    installed = {distribution.name: distribution.version for distribution in distributions()}
    versions = {
        "python": platform.python_version(),
        **{name: installed[name] for name in _PACKAGES if name in installed},
    }
    return [
        f"Command: {_command(context)}",
        f"Seed: {studies[0].seed}",
        "Versions: " + ", ".join(f"{name} {number}" for name, number in versions.items()),
        f"Machine: {processor_name()}, {os.cpu_count()} cores, {platform.system()}",
        f"Date: {time.strftime('%Y-%m-%d %H:%M %Z')}",
    ]


def _command(context: typer.Context) -> str:
    """The command line, reconstructed from the options that were given."""
    words = []
    for parameter in context.command.params:
        source = context.get_parameter_source(parameter.name or "")
        if source is not None and source.name == "COMMANDLINE":
            value = context.params[parameter.name or ""]
            values = value if isinstance(value, list | tuple) else [value]  # one option per value
            words += [parameter.opts[0]] if value is True else [w for v in values for w in (parameter.opts[0], str(v))]
    return f"{context.command_path} {shlex.join(words)}"


@contextmanager
def _progress_bar() -> Iterator[Callable[[str, float, float], None]]:
    """Progress bar on standard error for each data set, with the remaining time."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        Progress,
        TaskProgressColumn,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TaskProgressColumn(),
        TimeElapsedColumn(),
        TextColumn("left:"),
        TimeRemainingColumn(),
    )
    console = Console(stderr=True)
    bar = Progress(*columns, console=console)
    tasks: dict[str, Any] = {}
    noted = time.perf_counter()

    def show(label: str, done: float, total: float) -> None:
        nonlocal noted
        if label not in tasks:
            bar.start()  # with the first frame, so that early errors are printed without a bar
            tasks[label] = bar.add_task(label, total=total)
        bar.update(tasks[label], completed=done, total=total)
        if not console.is_terminal and time.perf_counter() - noted > 60.0:  # in a log, one line per minute
            noted = time.perf_counter()
            left = bar.tasks[tasks[label]].time_remaining
            share = done / total if total else 1.0  # 0 of 0: all results were stored before
            print_note(f"{label}: {share:.0%}" + (f", {left / 60:.0f} minutes left" if left else ""))

    try:
        yield show
    finally:
        if bar.live.is_started:
            bar.stop()
