"""`cobevglue demo`: two cars at a simulated junction find each other; numbers, pictures, a page."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from cobevglue.cli.errors import expected_errors
from cobevglue.cli.output import print_json, print_note, print_table

__all__ = ["demo"]


def demo(
    out: Annotated[Path, typer.Option(help="Folder for the pictures and the page.")] = Path("cobevglue-demo"),
    seed: Annotated[int, typer.Option(min=0, help="Of the scene; the same seed gives the same drive.")] = 0,
    as_json: Annotated[bool, typer.Option("--json", help="Print one JSON document.")] = False,
) -> None:
    """Simulate a junction and let two cars find each other without GPS.

    Both cars detect, track and exchange boxes; BEVGlue aligns them frame by frame. The boxes of the second car are then
    placed by BEVGlue's pose, and for comparison by noisy GPS, by GPS under attack and by the true pose. No third-party
    data are needed.
    """
    print_note("simulating and aligning 8 s of traffic (the first run compiles for some seconds) …")
    start = time.perf_counter()
    from cobevglue.demo import run_demo

    result = run_demo(seed)
    from cobevglue.visualization.demo_report import write_demo_report

    with expected_errors():
        files = write_demo_report(result, out, lambda name: print_note(f"drawing {out / name}"))
    summary = result.summary()
    if as_json:
        print_json({**summary, "files": [str(path) for path in files]})
        return
    _print_placement(summary)
    _print_alignment(summary)
    print(f"Open {files[0]} to see it ({time.perf_counter() - start:.0f} s).")


def _print_placement(summary: dict[str, Any]) -> None:
    from cobevglue.demo import POSE_SOURCES

    rows = []
    for source, name in POSE_SOURCES.items():
        placement = summary["placement"][source]
        error, within = placement["mean_error_m"], placement["boxes_within_2m"]
        cells = ("–" if error is None else f"{error:.2f} m", "–" if within is None else f"{within:.1%}")
        rows.append((name, *cells, f"{placement['frames']:.1%}"))
    title = "Where the other car's boxes end up"
    print_table(title, ("the pose comes from", "mean error", "boxes within 2 m", "frames with a pose"), rows)


def _print_alignment(summary: dict[str, Any]) -> None:
    alignment = summary["alignment"]
    success = [f"{alignment[f'success_{level}m_{level}deg']:.1%}" for level in (1, 2, 3)]
    median = alignment["median_error_m"]
    rows = [
        ("success within 1 m, 1° / 2 m, 2° / 3 m, 3°", " / ".join(success)),
        ("refused", f"{alignment['refused']:.1%}"),
        ("wrong accepts (off by more than 3 m or 3°)", f"{alignment['wrong_accepts']:.1%}"),
        ("median error", "–" if median is None else f"{median:.2f} m, {alignment['median_error_deg']:.2f}°"),
        ("message", f"{summary['message_bytes_per_frame']:.0f} bytes a frame"),
        ("time of an alignment, median / slowest", f"{alignment['median_ms']:.2f} / {alignment['slowest_ms']:.2f} ms"),
    ]
    print_table(f"BEVGlue over {summary['frames']} frames", ("", ""), rows)
