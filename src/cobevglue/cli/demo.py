"""`cobevglue demo`: collaborative perception at a simulated junction; prints a comparison, writes a report page."""

from __future__ import annotations

import time
from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from cobevglue.cli.errors import InputError, expected_errors
from cobevglue.cli.output import print_json, print_note, print_table

__all__ = ["demo"]

_NEEDED = {
    "perception": ("torch", "safetensors"),
    "simulation": ("libsumo", "embreex", "trimesh"),
}
"""Required modules by the extra that installs them."""
_NOTE_EVERY = 10  # frames


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the pictures and the page.")] = Path("cobevglue-demo"),
    seed: Annotated[int, typer.Option(min=0, help="Seed of the scene; the same seed gives the same sequence.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Collaborative perception of three simulated cars at a junction, without GPS.

    The whole system runs on the shipped weights: every car detects and tracks objects, BEVGlue estimates the relative
    poses, and features are fused. It is compared with no collaboration, and with fusion by poses from noisy GPS, from
    GPS under attack, and by the true poses. Writes pictures and a report page with a player of the sequence.

    Needs: pip install 'cobevglue[perception,simulation]'
    """
    _require_extras()
    start = time.perf_counter()
    print_note("simulating 4 s of traffic, perceiving and fusing (the first run compiles for some seconds) …")
    from cobevglue.demo import FRAMES, run_demo

    def note(done: int) -> None:
        if done % _NOTE_EVERY == 0:
            print_note(f"{done} of {FRAMES} frames")

    with expected_errors():
        out.mkdir(parents=True, exist_ok=True)  # errors are reported before the simulation
        result = run_demo(seed, progress=note)
        from cobevglue.visualization.demo_report import comparison_table, write_demo_report

        files = write_demo_report(result, out, lambda name: print_note(f"drawing {out / name}"))
    summary = result.summary()
    if as_json:
        print_json({**summary, "files": [str(path) for path in files]})
        return
    header, rows = comparison_table(summary)
    print_table(
        f"{summary['vehicles']:.1f} vehicles a frame, {summary['hidden_from_ego']:.1f} of them hidden from the ego",
        header,
        rows,
    )
    print("off: median pose error; bytes: of the object message, per frame and car. See the page for more.")
    print(f"Open {files[0]} to see it ({time.perf_counter() - start:.0f} s).")


def _require_extras() -> None:
    missing = {extra: [name for name in names if find_spec(name) is None] for extra, names in _NEEDED.items()}
    modules = ", ".join(name for names in missing.values() for name in names)
    if modules:
        extras = ",".join(extra for extra, names in missing.items() if names)
        raise InputError(f"the demonstration needs {modules}: pip install 'cobevglue[{extras}]'")
