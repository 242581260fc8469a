"""The pictures of the demonstration: where the other car's boxes end up, with which pose."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from matplotlib.animation import PillowWriter
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure

from cobevglue.demo import BEVGLUE, EGO, OTHER, POSE_SOURCES, TRUE_POSE, DemoFrame, DemoResult
from cobevglue.visualization import style
from cobevglue.visualization.bev import draw_agent, draw_boxes
from cobevglue.visualization.style import (
    GIVEN_POSE,
    MATCH,
    TRUTH,
    add_axes,
    legend_below,
    light_grid,
    new_figure,
    set_title,
    style_bev,
)

__all__ = ["draw_errors_over_time", "draw_placements", "typical_frame", "write_animation"]

_VIEW = 72.0  # the ego's surroundings that are shown, to each side [m]
_FRAMES_PER_PICTURE, _FRAMES_PER_SECOND = 2, 5
_LINES = {
    "gps_attacked": {"color": "black", "linewidth": 1.6},
    "gps_2.5": {"color": GIVEN_POSE, "linewidth": 1.6},
    "gps_0.5": {"color": GIVEN_POSE, "linewidth": 1.6, "linestyle": (0, (4, 2))},
    BEVGLUE: {"color": MATCH, "linewidth": 2.6},
    TRUE_POSE: {"color": TRUTH, "linewidth": 1.6, "linestyle": (0, (1, 1))},
}
"""How each pose source is drawn over time, the worst first."""


def typical_frame(result: DemoResult) -> DemoFrame:
    """The frame to show: of those that BEVGlue accepted the one with the median error, else the middle one."""
    accepted = [(error, frame.index) for frame in result.frames if (error := frame.pose_error) is not None]
    if not accepted:
        return result.frames[len(result.frames) // 2]
    return result.frames[sorted(accepted)[len(accepted) // 2][1]]


def draw_placements(
    frame: DemoFrame, sources: Sequence[str] = ("gps_2.5", "gps_attacked", BEVGLUE, TRUE_POSE)
) -> Figure:
    """The other's boxes placed with different poses over the vehicles as they really stand, in the ego's frame.

    Args:
        frame: one frame of the demonstration.
        sources: keys of `POSE_SOURCES`; a plot each, two in a row.
    """
    rows = (len(sources) + 1) // 2
    figure = new_figure(11.0, 5.7 * rows + 0.4)
    for axes, source in zip(add_axes(figure, rows, 2), sources, strict=False):
        _draw_placement(axes, frame, source)
    legend_below(figure)
    return figure


def draw_errors_over_time(result: DemoResult) -> Figure:
    """How far the other's boxes are from their objects in each frame, with each pose source; and what was matched."""
    figure = new_figure(11.0, 6.2)
    upper, lower = add_axes(figure, 2, 1, heights=(3.0, 1.0))
    times = [frame.time for frame in result.frames]
    for source, line in _LINES.items():
        errors = [frame.placement_error(source) for frame in result.frames]
        means = [np.nan if error is None or not len(error) else float(error.mean()) for error in errors]
        upper.plot(times, means, label=POSE_SOURCES[source], **line)  # type: ignore[arg-type]
    upper.set_yscale("log")
    upper.set_ylabel("mean error [m]")
    upper.yaxis.set_major_formatter("{x:g}")
    set_title(upper, f"How far the boxes from {OTHER} are from their objects")
    matched = [len(frame.alignment.matches) for frame in result.frames]
    lower.bar(times, matched, width=0.08, color=MATCH, alpha=0.6, label="matched objects")
    refused = [frame.time for frame in result.frames if frame.poses[BEVGLUE] is None]
    if refused:
        lower.plot(refused, np.zeros(len(refused)), "x", color="black", clip_on=False, label="BEVGlue refused")
    lower.set_ylabel("objects")
    lower.set_xlabel("time [s]")
    set_title(lower, "Objects that BEVGlue matched")
    for axes in (upper, lower):
        light_grid(axes)
        axes.set_xlim(times[0] - 0.1, times[-1] + 0.1)
    legend_below(figure, columns=4)
    return figure


def write_animation(result: DemoResult, path: str | Path, sources: Sequence[str] = ("gps_2.5", BEVGLUE)) -> Path:
    """An animated GIF of `draw_placements`, one plot beside the other, in real time.

    Args:
        result: the sequence.
        path: the file; its folder is made if it is not there.
        sources: keys of `POSE_SOURCES`.

    Returns:
        The file.
    """
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    figure = new_figure(5.0 * len(sources), 5.7)
    plots = add_axes(figure, 1, len(sources))
    writer = PillowWriter(fps=_FRAMES_PER_SECOND)
    with writer.saving(figure, str(target), dpi=80):
        for frame in result.frames[::_FRAMES_PER_PICTURE]:
            for axes, source in zip(plots, sources, strict=True):
                for artist in (*axes.collections, *axes.lines):
                    artist.remove()
                _draw_placement(axes, frame, source, size=10.5)
            if frame.index == 0:
                legend_below(figure, columns=4)
                figure.draw_without_rendering()
                figure.set_layout_engine(None)  # the plots stay where they are; computing that takes longest
            writer.grab_frame()
    return target


def _draw_placement(axes: Axes, frame: DemoFrame, source: str, size: float = 12.0) -> None:
    """The boxes of one frame, placed with one pose."""
    draw_boxes(axes, frame.truth, TRUTH, label="where vehicles really are", linewidth=0.8)
    draw_agent(axes, style.EGO, label=f"{EGO}, the ego")
    pose, errors = frame.poses[source], frame.placement_error(source)
    if pose is None or errors is None:
        title = f"{POSE_SOURCES[source]}: refused"
    else:
        color = {BEVGLUE: MATCH, TRUE_POSE: "black"}.get(source, GIVEN_POSE)
        placed = frame.other.transform(pose)
        draw_boxes(axes, placed, color, filled=False, linewidth=1.7)
        draw_agent(axes, color, x=pose.x, y=pose.y, yaw=pose.yaw)
        real = np.isfinite(frame.objects[:, 0])
        gaps = np.stack([placed.center[real, :2], frame.objects[real]], axis=1)
        axes.add_collection(LineCollection(list(gaps), colors=color, linewidths=1.0, linestyles=":", zorder=2.5))
        title = f"{POSE_SOURCES[source]}: boxes {errors.mean():.1f} m off" if len(errors) else POSE_SOURCES[source]
    # Stand-ins for the legend: the colour differs from plot to plot.
    axes.plot([], [], "s", color="black", markersize=9, markerfacecolor="none", label=f"boxes from {OTHER}, placed")
    axes.plot([], [], ":", color="black", label="from there to the vehicle")
    style_bev(axes, title)
    set_title(axes, title, size)
    axes.set_xlim(-_VIEW, _VIEW)
    axes.set_ylim(-_VIEW, _VIEW)
