"""`cobevglue bench`: run time of each step on this machine, and size of messages."""

from __future__ import annotations

from typing import Annotated

import typer

from cobevglue.cli.errors import expected_errors
from cobevglue.cli.output import print_json, print_note, print_table

__all__ = ["bench"]


def bench(
    weights: Annotated[
        str, typer.Option(help="Weights of the detector: a shipped name, or a .safetensors file.")
    ] = "compact",
    threads: Annotated[int, typer.Option(min=1, help="Threads of the detector's network.")] = 2,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Measure the run time of each step, and the size of messages, for several numbers of objects.

    Minimum and median over frames of two agents that share 60 % of their objects, without compilation. Alignment is
    measured for first frames, without state, and for later frames. Perception, from a stored cloud to tracked boxes, is
    measured if torch and the simulation are installed, on CUDA if available.
    """
    print_note("the first run compiles for some seconds …")
    from cobevglue.cli.measure import OBJECT_COUNTS, STEPS, measure
    from cobevglue.cli.measure_perception import measure_perception

    print_note("perception …")
    with expected_errors():
        perception = measure_perception(weights, threads)
    report = measure(lambda count: print_note(f"{count} objects …"))
    report["perception"] = perception
    if as_json:
        print_json(report)
        return
    rows = []
    for step in STEPS:
        for quantity in ("median", "best"):
            timed = [report["steps"][step][str(count)] for count in OBJECT_COUNTS]
            cells = ["–" if numbers is None else f"{numbers[f'{quantity}_ms']:.3f}" for numbers in timed]
            rows.append((f"{step}, {quantity}", *cells))
    header = ("milliseconds", *(f"{count} objects" for count in OBJECT_COUNTS))
    print_table("Time of each step for one frame", header, rows)
    sizes = ("message", *(str(report["message_bytes"][str(count)]) for count in OBJECT_COUNTS))
    print_table("Size", ("bytes", *header[1:]), [sizes])
    if perception is None:
        print_note("perception was not measured; it needs: pip install 'cobevglue[perception,simulation]'")
    else:
        stages = [(name, f"{t['median_ms']:.1f}", f"{t['best_ms']:.1f}") for name, t in perception["stages"].items()]
        title = "One cloud of {points} points, weights {weights}, {device}, {threads} threads".format(**perception)
        print_table(title, ("stage, milliseconds", "median", "best"), stages)
        if perception["largest_memory_mb"] is not None:
            print(f"peak memory of the process: {perception['largest_memory_mb']:.0f} MB")
    machine = report["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in report["versions"].items())
    print(f"{machine['processor']}, {machine['cores']} cores, {machine['system']}; {versions}")
