"""The demonstration as a folder of pictures and a page that explains them."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cobevglue
from cobevglue.demo import COBEVGLUE, IOU, MIN_POINTS, NETWORK, NOISE, ROWS, SCORE, DemoFrame, DemoResult
from cobevglue.visualization.demo_pictures import draw_comparison, draw_pose, witness
from cobevglue.visualization.demo_player import player
from cobevglue.visualization.report_page import Part, figure, paragraphs, table, write_page
from cobevglue.visualization.style import save_figure

__all__ = ["comparison_table", "write_demo_report"]

PAGE, COMPARISON, POSE = "index.html", "comparison.png", "pose.png"


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
    pictures = []
    for name, draw in ((COMPARISON, draw_comparison), (POSE, draw_pose)):
        if progress is not None:
            progress(name)
        pictures.append(save_figure(draw(result), target / name))
    if progress is not None:
        progress(PAGE)
    return [_write_page(result, target), *pictures]


def comparison_table(summary: dict[str, Any]) -> tuple[list[str], list[list[str]]]:
    """The comparison as text.

    Args:
        summary: as `DemoResult.summary` returns it.

    Returns:
        The names of the columns, and a row for each of `ROWS`.
    """
    header = ["", "AP 0.5", "AP 0.7", "found", "hidden", "ghosts", "off", "bytes"]
    rows = []
    for name, row in zip(ROWS.values(), summary["rows"].values(), strict=True):
        scores = [_number(row[key], 3) for key in ("ap_0.5", "ap_0.7")]
        counts = [_number(row[key], 1) for key in ("found", "hidden_found", "ghosts")]
        rows.append([name, *scores, *counts, _length(row["median_error_m"]), _number(row["bytes_for_pose"] or 0.0, 0)])
    return header, rows


def _write_page(result: DemoResult, folder: Path) -> Path:
    summary, story = result.summary(), result.story()
    header, rows = comparison_table(summary)
    parts = [
        Part(
            "At a glance",
            paragraphs(_story(story))
            + figure(
                (folder / COMPARISON).read_bytes(),
                "The same moment four times, as the ego has it: it stands in the middle and looks to the right. Dots "
                "are what the LiDARs measured, blue the ego's own, orange the others', placed where the ego believes "
                "the others to be. Grey are the roads, for orientation.",
                "Four maps: the ego alone, fused on noisy GPS, fused under attack, and CoBEVGlue.",
            ),
        ),
        Part(
            "The comparison",
            paragraphs(
                f"On average {summary['vehicles']:.1f} vehicles are in reach in a frame, "
                f"{summary['hidden_from_ego']:.1f} of them hidden from the ego."
            )
            + table(header, rows, [list(ROWS).index(COBEVGLUE)], _table_notes(summary)),
        ),
        Part(
            "The drive",
            paragraphs(
                "Choose how what the cars saw is put together, and watch where the orange points come to lie: they are "
                "what the others measured, placed where the ego believes the others to be. With the true poses they "
                "continue the ego's own, blue ones. Under attack they are somewhere else."
            )
            + player(result),
        ),
        Part(
            f"How {story.ego} finds {witness(result)}",
            paragraphs(
                "Each car makes a graph of what it detected: objects are nodes; distances, directions and headings "
                "between them are edges. None of these depends on where a car believes to be. BEVGlue looks for the "
                "part that both graphs have in common (green, equal numbers). The motion that brings one onto the "
                "other is the relative pose. Where that could be chance, BEVGlue refuses, and the other car is left "
                "out of this frame."
            )
            + figure(
                (folder / POSE).read_bytes(),
                "What both cars track in the moment above, each in its own frame, and together.",
                "Two object graphs with their common part in green, and the boxes of both in one frame.",
            ),
        ),
        Part("What the bytes are", paragraphs(_bytes(summary))),
        Part("What this is, and what it is not", paragraphs(_limits(summary))),
    ]
    seed = summary["seed"]
    footer = (
        f"cobevglue {cobevglue.__version__}, seed {seed}, Python {summary['machine']['python']} on "
        f"{summary['machine']['processor']}. Again: cobevglue demo --seed {seed}"
    )
    lead = (
        f"{_count(summary['agents'])} cars with LiDARs meet at a junction. Each sees vehicles that the others cannot. "
        "They share what they see; but to use it, a car must know where the others are. Most systems ask GPS, which "
        "can be off, jammed or faked. CoBEVGlue does not: it finds the others by the vehicles that both see."
    )
    return write_page(folder / PAGE, "Seeing together without trusting GPS", lead, parts, footer)


def _story(frame: DemoFrame) -> str:
    text = (
        f"At {frame.time:.1f} s there are {frame.counted.sum()} vehicles in reach of {frame.ego}, the ego. "
        f"{frame.hidden.sum()} of them (orange rings) it cannot find by itself: other vehicles or walls hide them. "
    )
    movers = frame.hidden_movers
    if len(movers):
        row = int(movers[0])
        x, y = frame.truth.center[row, :2]
        own = frame.own_point_count[row]
        found = [ROWS[name] for name in ROWS if frame.verdict(name).found[row]]
        missed = [name for name in ROWS.values() if name not in found]
        text += (
            f"One of these drives at {3.6 * frame.speed[row]:.0f} km/h, {abs(x):.0f} m "
            f"{'ahead' if x > 0 else 'behind'} and {abs(y):.0f} m to the {'left' if y > 0 else 'right'}: {own} of the "
            "ego's points lie on it, and "
            f"{frame.point_count[row] - own} of the others'. It was found by: {_listed(found)}; and missed by: "
            f"{_listed(missed)}. "
        )
    return text + (
        "\n\nThe moment was chosen by what is there, not by what was found: it is the first of those in which most "
        "hidden vehicles drive within 50 m."
    )


def _table_notes(summary: dict[str, Any]) -> list[str]:
    used = summary["rows"][COBEVGLUE]["poses_used"] or 0.0
    return [
        f"All rows: {summary['frames']} frames, the same clouds and detector and, but for ego only, the same fusion.",
        "AP: average precision at that overlap with the true box, seen from above; 1 is perfect.",
        "Found, how many of these are hidden from the ego, and ghosts: numbers a frame, at a score of "
        f"{SCORE:g} and an overlap of {IOU:g} or more. Vehicles count that at least {MIN_POINTS} points of all LiDARs "
        f"together lie on; hidden ones have fewer than {MIN_POINTS} of the ego's. A ghost is a box that overlaps no "
        "vehicle by that much.",
        f"Noisy GPS: Gaussian, standard deviation {NOISE.position:g} m in x and in y and {NOISE.yaw:g}° in heading, "
        "for every car anew in every frame. Under attack: the others claim to be where the ego is.",
        "Off: how far the pose is from the true one, median over frames and cars, of the poses that were used. "
        f"CoBEVGlue used {100.0 * used:.0f} % of them, and refused the rest.",
        "Bytes: what a car that helps sends for its pose, a frame; the features come on top, as said below.",
    ]


def _bytes(summary: dict[str, Any]) -> str:
    row = summary["rows"][COBEVGLUE]
    given = summary["rows"]["noisy_gps"]["bytes_for_pose"]
    if row["bytes_for_pose"] is None or given is None:
        return "No other car was there."
    features = row["bytes_in_all"] - row["bytes_for_pose"]
    return (
        "Nearly all that a car sends is what its network makes of its cloud, three maps of features: "
        f"{features:,.0f} bytes a frame, in every row. To place them by GPS takes a pose, {given:,.0f} bytes. "
        f"CoBEVGlue sends what the car tracks instead, 32 bytes a box: {row['bytes_for_pose']:,.0f} bytes, "
        f"{100.0 * row['bytes_for_pose'] / features:.2f} % of the features."
    )


def _limits(summary: dict[str, Any]) -> str:
    times = ", ".join(f"{stage} {ms:.0f} ms" for stage, ms in summary["median_ms"].items() if ms is not None)
    return (
        f"Traffic and LiDARs are simulated, on a road network ({NETWORK}) that nothing was trained on. Detector, "
        "tracker, alignment and fusion are those that run on real clouds. CoBEVGlue gets clouds only: no pose, no map, "
        "no roads. The junction is a busy one, and the ego is the car from which most driving vehicles are hidden, so "
        "that there is something to gain; cobevglue reproduce measures on drives that nobody chose."
        f"\n\nTime for a frame of {summary['agents']} cars, the median here: {times or 'not measured'}, with the other "
        "rows and the simulation running beside it; cobevglue bench times each step by itself. On the road, every car "
        "has its own computer for its perception."
    )


def _length(metres: float | None) -> str:
    if metres is None:
        return "–"
    return f"{100.0 * metres:.0f} cm" if metres < 1.0 else f"{metres:.{1 if metres < 10.0 else 0}f} m"


def _number(value: float | None, digits: int) -> str:
    return "–" if value is None or math.isnan(value) else f"{value:,.{digits}f}"


def _count(number: int) -> str:
    return {1: "One", 2: "Two", 3: "Three", 4: "Four"}.get(number, str(number))


def _listed(names: list[str]) -> str:
    return ", ".join(names) if names else "nobody"
