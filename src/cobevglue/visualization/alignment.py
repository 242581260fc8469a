"""One alignment as a picture: both object graphs, what they have in common, and the other's boxes brought home."""

from __future__ import annotations

import math
import textwrap
from typing import TYPE_CHECKING

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cobevglue.boxes import Boxes
from cobevglue.se2 import wrap_angle
from cobevglue.typing import FloatArray
from cobevglue.visualization.bev import draw_agent, draw_boxes, draw_object_graph, draw_pairs
from cobevglue.visualization.style import EGO, OTHER, add_axes, legend_below, new_figure, same_scale, style_bev

if TYPE_CHECKING:
    from cobevglue.alignment import Alignment

__all__ = ["draw_alignment", "draw_together"]

_NUMBERS_AT_MOST = 12


def draw_alignment(
    ego: Boxes, other: Boxes, alignment: Alignment, *, ego_name: str = "ego", other_name: str = "other"
) -> Figure:
    """Three plots: the ego's object graph; the other's, in its own frame; the other's boxes in the ego's frame.

    Matched objects have the same number in the first two plots; if there are many, only some of them have one.

    Args:
        ego: M boxes in the ego's frame.
        other: N boxes in the other's frame.
        alignment: what was found, or a refusal: the third plot then says why.
        ego_name: what the picture calls the ego.
        other_name: what the picture calls the other.
    """
    figure = new_figure(15.0, 5.5)
    left, middle, right = add_axes(figure, 1, 3)
    matches = np.asarray(alignment.matches, dtype=np.int64).reshape(-1, 2)
    names = _spread_numbers(ego.center[matches[:, 0], :2])
    style_bev(left, f"1  What {ego_name} saw")
    draw_object_graph(left, ego, EGO, common=matches[:, 0], names=names, label=f"boxes of {ego_name}")
    draw_agent(left, EGO, label=ego_name)
    style_bev(middle, f"2  What {other_name} saw, in its own frame")
    draw_object_graph(
        middle, other, OTHER, common=matches[:, 1], names=names, filled=False, label=f"boxes of {other_name}"
    )
    draw_agent(middle, OTHER, label=other_name)
    draw_together(right, ego, other, alignment, ego_name=ego_name, other_name=other_name, number="3  ")
    same_scale([left, middle, right])
    legend_below(figure)
    return figure


def draw_together(
    axes: Axes,
    ego: Boxes,
    other: Boxes,
    alignment: Alignment,
    *,
    ego_name: str = "ego",
    other_name: str = "other",
    number: str = "",
) -> None:
    """The ego's boxes and, unless refused, the other's moved by the pose that was found, matched ones joined.

    Args:
        axes: the plot, in the ego's frame.
        ego: M boxes in the ego's frame.
        other: N boxes in the other's frame.
        alignment: what was found, or a refusal: the plot then says why.
        ego_name: what the legend calls the ego.
        other_name: what the legend calls the other.
        number: what the title begins with.
    """
    draw_boxes(axes, ego, EGO, label=f"boxes of {ego_name}")
    draw_agent(axes, EGO, label=ego_name)
    pose = alignment.ego_SE2_other
    if pose is None:
        style_bev(axes, f"{number}Refused: no pose, nothing is moved")
        reason = textwrap.fill(alignment.reason, 46)
        frame = {"facecolor": "white", "edgecolor": "#999999", "boxstyle": "round,pad=0.4"}
        axes.text(
            0.03, 0.97, reason, transform=axes.transAxes, ha="left", va="top", fontsize=11.0, bbox=frame, zorder=9.0
        )
        return
    where = f"x {pose.x:.1f} m, y {pose.y:.1f} m, yaw {math.degrees(wrap_angle(pose.yaw)):.1f}°"
    style_bev(axes, f"{number}Together: {where}")
    moved = other.transform(pose)
    draw_boxes(axes, moved, OTHER, label=f"boxes of {other_name}", filled=False)
    draw_agent(axes, OTHER, x=pose.x, y=pose.y, yaw=pose.yaw, label=other_name)
    draw_pairs(axes, ego[alignment.matches[:, 0]], moved[alignment.matches[:, 1]])


def _spread_numbers(at: FloatArray) -> list[str]:
    """(K,) "1", "2", … for points (K, 2) far from each other, "" for the rest where there are too many to read."""
    names = [""] * len(at)
    if not len(at):
        return names
    distance = np.linalg.norm(at - at.mean(axis=0), axis=1)
    for number in range(1, min(len(at), _NUMBERS_AT_MOST) + 1):
        row = int(distance.argmax())
        names[row] = str(number)
        to_row = np.linalg.norm(at - at[row], axis=1)
        distance = to_row if number == 1 else np.minimum(distance, to_row)
        distance[row] = -1.0
    return names
