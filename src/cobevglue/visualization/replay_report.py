"""The results of a replay as pictures and a page: verdicts, risk and time offset over time, and frames from above."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

import cobevglue
from cobevglue.boxes import Boxes
from cobevglue.iou import bev_iou
from cobevglue.replay.replay import Replay, ReplayFrame
from cobevglue.replay.summary import Summary
from cobevglue.visualization.alignment import draw_alignment
from cobevglue.visualization.bev import draw_agent, draw_boxes
from cobevglue.visualization.report_page import Part, figure, paragraphs, table, write_page
from cobevglue.visualization.style import (
    EGO,
    MATCH,
    OTHER,
    TRUTH,
    add_axes,
    figure_png,
    legend_below,
    light_grid,
    new_figure,
    same_scale,
    save_figure,
    set_title,
    style_bev,
)

__all__ = ["agent_table", "draw_frame", "draw_timeline", "write_replay_report"]

PAGE, TIMELINE, FRAME = "index.html", "timeline.png", "frame.png"
_MATCHED_AGENTS = 4
"""Other agents whose matches are drawn, at most."""
_AGENT_COLORS = (OTHER, "#AA4499", "#E69F00", "#56B4E9", "#882255", "#999933", "#332288")


def draw_timeline(summary: Summary) -> Figure:
    """Three plots over time: accepted and refused frames, the risk, and the time offset of each other agent."""
    names = list(summary.agents)
    figure_ = new_figure(12.0, 4.6 + 0.3 * len(names))
    verdict, risk, offset = add_axes(figure_, 3, 1, heights=[0.5 + 0.25 * len(names), 1.6, 1.6])
    start = min((series.table[0, 0] for series in summary.agents.values()), default=0.0)
    for row, (name, series) in enumerate(summary.agents.items()):
        color = _AGENT_COLORS[row % len(_AGENT_COLORS)]
        values = series.table
        time, accepted = values[:, 0] - start, np.isfinite(values[:, 3])
        for shown, kind, label in ((accepted, MATCH, "accepted"), (~accepted, TRUTH, "refused")):
            verdict.scatter(time[shown], np.full(shown.sum(), row), s=26, marker="|", color=kind, label=label)
        risk.plot(time, np.clip(values[:, 1], 1e-4, 1.0), color=color, linewidth=1.2, label=name)
        offset.plot(time, 1e3 * values[:, 2], color=color, linewidth=1.2, marker=".", markersize=3, label=name)
    verdict.set_yticks(range(len(names)), names)
    verdict.set_ylim(len(names) - 0.5, -0.5)
    set_title(verdict, "Verdict")
    risk.set_yscale("log")
    set_title(risk, "Estimated risk that the pose is wrong")
    set_title(offset, "Time offset: the other's list shows the world so much later than the ego's [ms]")
    offset.set_xlabel("time [s]")
    for axes in (risk, offset):
        light_grid(axes)
        axes.sharex(verdict)
    legend_below(figure_)
    return figure_


def draw_frame(frame: ReplayFrame, ego: str) -> Figure:
    """Two maps in the ego frame: the ego's own objects, and everyone's, with those that it does not detect itself."""
    figure_ = new_figure(13.0, 7.0)
    alone, together = add_axes(figure_, 1, 2)
    own, fused = frame.seen.lists[ego], frame.seen.objects
    style_bev(alone, f"{ego} alone: {len(own)} objects")
    draw_boxes(alone, own, EGO, label=f"detected by {ego}")
    draw_agent(alone, EGO, label=ego)
    new = _only_others(fused, own)
    accepted = [name for name, alignment in frame.seen.alignments.items() if alignment.accepted]
    title = f"with {', '.join(accepted)}" if accepted else "no other agent aligned"
    style_bev(together, f"{title}: {len(fused)} objects")
    draw_boxes(together, fused[~new], EGO, label=f"detected by {ego}")
    draw_boxes(together, fused[new], MATCH, label="only by others", linewidth=1.8)
    draw_agent(together, EGO, label=ego)
    for row, name in enumerate(frame.seen.alignments):
        pose = frame.seen.alignments[name].ego_SE2_other
        if pose is not None:
            color = _AGENT_COLORS[row % len(_AGENT_COLORS)]
            draw_agent(together, color, x=pose.x, y=pose.y, yaw=pose.yaw, label=name)
    (x0, x1), (y0, y1) = together.get_xlim(), together.get_ylim()
    alone.set_xlim(min(x0, alone.get_xlim()[0]), max(x1, alone.get_xlim()[1]))
    alone.set_ylim(min(y0, alone.get_ylim()[0]), max(y1, alone.get_ylim()[1]))
    together.set_xlim(alone.get_xlim())
    together.set_ylim(alone.get_ylim())
    same_scale([alone, together])
    legend_below(figure_)
    return figure_


def agent_table(summary: Summary) -> tuple[list[str], list[list[str]]]:
    """The other agents as text: the names of the columns, and a row for each."""
    header = ["agent", "frames", "accepted", "refused", "time offset", "last pose x, y, yaw"]
    rows = []
    for name, series in summary.agents.items():
        values = series.table
        known = values[np.isfinite(values[:, 2]), 2]
        poses = values[np.isfinite(values[:, 3]), 3:]
        last = f"{poses[-1, 0]:.1f} m, {poses[-1, 1]:.1f} m, {math.degrees(poses[-1, 2]):.1f}°" if len(poses) else ""
        share = f"{series.accepted} ({100.0 * series.accepted / len(values):.0f} %)"
        offset = f"{1e3 * float(np.median(known)):.0f} ms" if len(known) else ""
        refused = "; ".join(f"{count} {cause}" for cause, count in series.refused.most_common())
        rows.append([name, str(len(values)), share, refused, offset, last])
    return header, rows


def write_replay_report(replay: Replay, summary: Summary, shown: Sequence[ReplayFrame], folder: Path) -> list[Path]:
    """Write the pictures and the page with all of them inside.

    Args:
        replay: that has been read.
        summary: of its frames.
        shown: frames to draw, at least one.
        folder: where the files go; files of the same names are replaced.

    Returns:
        The files, the page first.

    Raises:
        OSError: a file cannot be written.
    """
    pictures = [draw_frame(frame, replay.ego) for frame in shown]
    best = max(range(len(shown)), key=lambda k: len(shown[k].seen.objects))
    most = shown[best].seen
    matched = [
        draw_alignment(most.lists[replay.ego], most.lists[name], alignment, ego_name=replay.ego, other_name=name)
        for name, alignment in list(most.alignments.items())[:_MATCHED_AGENTS]
    ]
    files = [save_figure(draw_timeline(summary), folder / TIMELINE), save_figure(pictures[best], folder / FRAME)]
    header, rows = agent_table(summary)
    problems = [problem for stream in replay.streams.values() for problem in stream.problems()]
    start = shown[0].time
    parts = [
        Part(
            "Do the agents find each other?",
            table(header, rows, notes=_NOTES) + figure((folder / TIMELINE).read_bytes(), _TIMELINE_CAPTION),
        ),
        Part(
            "What the ego gains",
            paragraphs(
                f"In a frame {replay.ego} has {summary.own_objects / summary.frames:.1f} objects alone, and "
                f"{summary.fused_objects / summary.frames:.1f} together with the others."
            )
            + "".join(
                figure(figure_png(picture), f"Frame {frame.index}, {frame.time - start:.1f} s after the first picture.")
                for picture, frame in zip(pictures, shown, strict=True)
            ),
        ),
        Part(
            "How they are found",
            paragraphs(
                "The pose of another agent is the motion that brings its objects onto those of the ego. Matched "
                "objects have the same number; green are the distances that both lists have in common."
            )
            + "".join(figure(figure_png(picture), f"Frame {shown[best].index}.") for picture in matched),
        ),
        Part("The recording", table(*_stream_table(replay), notes=problems)),
    ]
    lead = (
        f"{summary.frames} object lists of {replay.ego}, each with the newest lists of the other agents. Their poses "
        f"come from the objects alone: no GPS, no map."
    )
    footer = f"cobevglue {cobevglue.__version__}; {replay.recording.path}"
    page = write_page(folder / PAGE, f"Replay of {replay.recording.path.name}", lead, parts, footer)
    return [page, *files]


_NOTES = (
    "accepted: frames with a pose; refused: frames in which the objects do not suffice for a sure one, with the cause",
    "time offset: the median; negative if the other's list is older than the ego's",
    "pose: of the other agent in the ego's frame, x forward and y to the left",
)
_TIMELINE_CAPTION = "Verdict, risk and time offset of each other agent over time. Refused frames have no pose."


def _only_others(fused: Boxes, own: Boxes) -> Any:
    """(N,) whether a fused object overlaps none of the ego's own."""
    return ~(bev_iou(fused, own) > 0.0).any(axis=1) if len(own) else np.ones(len(fused), dtype=bool)


def _stream_table(replay: Replay) -> tuple[list[str], list[list[str]]]:
    header = ["agent", "topic", "lists", "rate", "longest gap"]
    rows = [
        [agent, stream.topic, str(stream.lists), f"{stream.rate:.1f} Hz", f"{stream.longest_gap:.2f} s"]
        for agent, stream in sorted(replay.streams.items(), key=lambda each: each[0] != replay.ego)
    ]
    return header, rows
