"""The demonstration as a folder of pictures and a page that explains them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import cobevglue
from cobevglue.demo import BEVGLUE, EGO, OTHER, POSE_SOURCES, DemoFrame, DemoResult
from cobevglue.visualization.alignment import draw_alignment
from cobevglue.visualization.demo_pictures import (
    draw_errors_over_time,
    draw_placements,
    typical_frame,
    write_animation,
)
from cobevglue.visualization.report_page import Section, Table, write_page
from cobevglue.visualization.style import save_figure

__all__ = ["write_demo_report"]

GRAPHS, PLACEMENTS, ERRORS = "object_graphs.png", "placements.png", "error_over_time.png"
ANIMATION, PAGE = "animation.gif", "index.html"


def write_demo_report(
    result: DemoResult, folder: str | Path, progress: Callable[[str], None] | None = None
) -> list[Path]:
    """Write the pictures of a demonstration, and the page with all of them inside.

    Args:
        result: what happened.
        folder: made if it is not there; files of the same names are replaced.
        progress: called with the name of each file before it is made.

    Returns:
        The files, the page first.

    Raises:
        OSError: a file cannot be written.
    """
    target = Path(folder)
    frame = typical_frame(result)
    makers: dict[str, Callable[[Path], Path]] = {
        GRAPHS: lambda path: save_figure(
            draw_alignment(frame.ego, frame.other, frame.alignment, ego_name=EGO, other_name=OTHER), path
        ),
        PLACEMENTS: lambda path: save_figure(draw_placements(frame), path),
        ERRORS: lambda path: save_figure(draw_errors_over_time(result), path),
        ANIMATION: lambda path: write_animation(result, path),
    }
    pictures = []
    for name, make in makers.items():
        if progress is not None:
            progress(name)
        pictures.append(make(target / name))
    if progress is not None:
        progress(PAGE)
    return [_write_page(result.summary(), frame, target), *pictures]


def _write_page(summary: dict[str, Any], frame: DemoFrame, folder: Path) -> Path:
    objects, alignment = summary["objects_per_frame"], summary["alignment"]
    sections = [
        Section(
            "Where do the other car's boxes end up?",
            [
                f"{OTHER} sends what it sees. To use it, {EGO} must know where {OTHER} is. If that is wrong, every box "
                "lands in the wrong place: a parked car stands in the middle of the lane. The table says how far the "
                "boxes are from the vehicles that they are of, depending on where the relative pose comes from.",
                "Even with the true pose something remains: the detector itself is not exact. No pose can do better.",
            ],
            table=_placement_table(summary),
        ),
        Section(
            "The drive",
            [
                f"Everything is drawn as {EGO} sees it: it stays at the origin and looks to the right. Grey is where "
                f"the vehicles really are. Left: the boxes that {OTHER} sent, placed by a noisy GPS. Right: the same "
                "boxes, placed by BEVGlue. In a frame that BEVGlue refuses, nothing is placed.",
            ],
            picture=folder / ANIMATION,
            picture_text="Animation: the same boxes over time, placed by noisy GPS (left) and by BEVGlue (right).",
        ),
        Section(
            f"One moment, at {frame.time:.1f} s",
            [
                "The same boxes placed four times. Dotted lines lead from a box to the vehicle that it is of. Under "
                f"attack, {OTHER} claims to stand where {EGO} stands. This is the frame in which BEVGlue's error is "
                "the median of the drive, not its best one.",
            ],
            picture=folder / PLACEMENTS,
            picture_text="Four maps: boxes placed with noisy GPS, attacked GPS, BEVGlue and the true pose.",
        ),
        Section(
            "How BEVGlue does it",
            [
                "Each car turns its boxes into a graph: the objects are nodes, and the distances, directions and "
                "headings between them are edges. These do not depend on where a car believes to be. BEVGlue "
                "looks for the part that both graphs have in common (green, the same numbers left and in the middle). "
                "The motion that brings one onto the other is the relative pose (right).",
            ],
            picture=folder / GRAPHS,
            picture_text="Two object graphs with their common part in green, and the boxes of both in one frame.",
        ),
        Section(
            "Over time",
            [
                "Each line is the mean distance between the boxes and their vehicles; mind that the scale is "
                "logarithmic. A gap in the green line is a refusal: BEVGlue says so if what it found could be chance.",
            ],
            picture=folder / ERRORS,
            picture_text="Lines over time: the error of boxes with each pose source, and how many objects matched.",
        ),
        Section(
            "The numbers",
            [
                f"All {summary['frames']} frames count. A refusal is not a success. A wrong accept is a pose that was "
                "accepted although it is off by more than 3 m or 3°.",
            ],
            table=_number_table(summary),
        ),
        Section(
            "What this is, and what it is not",
            [
                "The junction is simulated, with vehicles on scripted paths. There is no LiDAR and no neural network "
                "here: the boxes are the true ones, with the errors that a detector makes (displaced, missed, turned "
                "round, invented). BEVGlue gets the boxes of the two cars, each in its own frame, and no position.",
                f"{EGO} sees {objects['ego']:.0f} objects a frame. The message adds {objects['new_from_other']:.0f} "
                f"that it did not detect itself, for {summary['message_bytes_per_frame']:.0f} bytes. An alignment "
                f"takes {alignment['median_ms']:.2f} ms.",
            ],
        ),
    ]
    footer = (
        f"cobevglue {cobevglue.__version__}, seed {summary['seed']}, Python {summary['machine']['python']} on "
        f"{summary['machine']['processor']}. Again: cobevglue demo --seed {summary['seed']}"
    )
    lead = (
        "Two cars meet at a junction. Each sees only some of the vehicles around. They share what they see, and "
        "find out where the other one is from the vehicles that both see. GPS, which can be off, "
        "jammed or faked, is not used."
    )
    return write_page(folder / PAGE, "Seeing together without trusting GPS", lead, sections, footer)


def _placement_table(summary: dict[str, Any]) -> Table:
    rows = []
    for source, name in POSE_SOURCES.items():
        placement = summary["placement"][source]
        rows.append(
            [
                name,
                _metres(placement["mean_error_m"]),
                _percent(placement["boxes_within_2m"]),
                _percent(placement["frames"]),
            ]
        )
    header = ["the pose comes from", "mean distance to the vehicle", "boxes within 2 m", "frames with a pose"]
    return Table(header, rows, strong=list(POSE_SOURCES).index(BEVGLUE))


def _number_table(summary: dict[str, Any]) -> Table:
    alignment = summary["alignment"]
    rows = [
        ("success within 1 m and 1°", _percent(alignment["success_1m_1deg"])),
        ("success within 2 m and 2°", _percent(alignment["success_2m_2deg"])),
        ("success within 3 m and 3°", _percent(alignment["success_3m_3deg"])),
        ("refused", _percent(alignment["refused"])),
        ("wrong accepts", _percent(alignment["wrong_accepts"])),
        ("median error of accepted poses", _median_error(alignment)),
        ("objects matched in a frame", f"{summary['objects_per_frame']['matched']:.1f}"),
        ("message", f"{summary['message_bytes_per_frame']:.0f} bytes a frame"),
        ("time of an alignment, median", f"{alignment['median_ms']:.2f} ms"),
    ]
    return Table(["BEVGlue", ""], rows)


def _median_error(alignment: dict[str, Any]) -> str:
    if alignment["median_error_m"] is None:
        return "–"
    return f"{alignment['median_error_m']:.2f} m, {alignment['median_error_deg']:.2f}°"


def _metres(value: float | None) -> str:
    return "–" if value is None else f"{value:.2f} m"


def _percent(share: float | None) -> str:
    return "–" if share is None else f"{100.0 * share:.1f} %"
