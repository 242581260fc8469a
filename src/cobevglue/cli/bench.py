"""`cobevglue bench`: how fast each step is on this machine, and how long messages are."""

from __future__ import annotations

from typing import Annotated

import typer

from cobevglue.cli.output import print_json, print_note, print_table

__all__ = ["bench"]


def bench(as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False) -> None:
    """Measure the speed of each step, and the size of messages, over object counts.

    Best and median of repeated frames of two agents that share 60 % of their objects; compilation is not counted. A
    first frame is searched without knowing anything; later frames use what was found before.
    """
    print_note("the first run compiles for some seconds …")
    from cobevglue.cli.measure import OBJECT_COUNTS, STEPS, measure

    report = measure(lambda count: print_note(f"{count} objects …"))
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
    machine = report["machine"]
    versions = ", ".join(f"{name} {version}" for name, version in report["versions"].items())
    print(f"{machine['processor']}, {machine['cores']} cores, {machine['system']}; {versions}")
