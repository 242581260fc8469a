"""The figures of a study: average precision over localisation noise and over communication, and detections.

All are returned as the bytes of PNG files.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cobevglue.boxes import Boxes
from cobevglue.typing import FloatArray
from cobevglue.visualization.alignment import draw_together
from cobevglue.visualization.bev import draw_agent, draw_boxes
from cobevglue.visualization.detections import draw_points
from cobevglue.visualization.style import (
    MATCH,
    TRUTH,
    add_axes,
    figure_png,
    is_cobevglue,
    legend_below,
    light_grid,
    new_figure,
    set_title,
    style_bev,
)

if TYPE_CHECKING:
    from cobevglue.alignment import Alignment

__all__ = ["ap_over_bytes", "ap_over_noise", "detections_picture", "matching_picture"]

_COLORS = ("#0072B2", "#D55E00", "#AA4499", "#E69F00", "#56B4E9", "#882255", "#999933", "#332288", "#CC79A7", "#A05A2C")
"""Colours of lines without a colour of their own; with the markers, seventy combinations. Green is CoBEVGlue's."""
_MARKERS = ("o", "s", "^", "D", "v", "P", "X")
_DETECTION = "#C8102E"
_TRUE_BOX = "#1A8A4A"
"""Green and red, as in the paper; ground-truth boxes are filled, detections are outlines."""
_EGO_ONLY = ("ego only", "no collaboration", "none")


def ap_over_noise(levels: Sequence[str], curves: Mapping[str, Sequence[float]], title: str) -> bytes:
    """Average precision of methods over levels of localisation noise.

    CoBEVGlue is set off by its width, ego only ("none", "no collaboration") is dashed and black. The legend has the
    methods from the best at the last level to the worst.

    Args:
        levels: L names of the levels, from none to strong.
        curves: of each method L values; NaN where there is none.
        title: of the figure.

    Raises:
        ValueError: a curve has not as many values as there are levels; names it.
    """
    figure = new_figure(8.6, 4.8)
    (axes,) = add_axes(figure, 1, 1)
    for (name, values), style in zip(curves.items(), _styles(list(curves)), strict=True):
        if len(values) != len(levels):
            raise ValueError(f"curve {name!r} has {len(values)} values for {len(levels)} levels")
        axes.plot(np.arange(len(levels)), values, label=name, **style)
    axes.set_xticks(np.arange(len(levels)), levels)
    axes.set_xlabel("localisation noise")
    last = {name: values[-1] if len(values) and not math.isnan(values[-1]) else -1.0 for name, values in curves.items()}
    _finish(figure, axes, title, sorted(curves, key=lambda name: -last[name]))
    return figure_png(figure)


def ap_over_bytes(points: Sequence[tuple[str, float, float]], title: str, base: float = 10.0) -> bytes:
    """Average precision over communication volume.

    Points with equal labels are joined by a line; labels that start the same, up to the first comma or else the first
    space, share a colour. What needs no bytes at all is a horizontal line.

    Args:
        points: label, bytes a frame, average precision.
        title: of the figure.
        base: of the logarithmic scale of bytes.
    """
    figure = new_figure(8.6, 4.8)
    (axes,) = add_axes(figure, 1, 1)
    labels = list(dict.fromkeys(label for label, _, _ in points))
    families = list(dict.fromkeys(map(_family, labels)))
    others = [family for family in families if not is_cobevglue(family) and family.casefold() != "bevglue"]
    for label in labels:
        family = _family(label)
        ours = family not in others
        color = MATCH if ours else _COLORS[others.index(family) % len(_COLORS)]
        if label.casefold().startswith(_EGO_ONLY):
            color = "black"
        number = [other for other in labels if _family(other) == family].index(label)
        sizes, values = np.array(sorted((size, ap) for name, size, ap in points if name == label)).T
        for ap in values[sizes <= 0]:
            axes.axhline(ap, color=color, linestyle="--", linewidth=1.4, label=f"{label} (nothing sent)")
        if (sizes > 0).any():
            marker: dict[str, Any] = {"marker": "*" if ours else _MARKERS[number % len(_MARKERS)]}
            marker |= {"markersize": 15.0 if ours else 8.0, "zorder": 4.0 if ours else 3.0}
            # CoBEVGlue itself is filled, its variants are hollow; they share the marker.
            variant = ours and "," in label
            marker |= (
                {"markeredgecolor": color, "markerfacecolor": "white"} if variant else {"markeredgecolor": "white"}
            )
            style = "--" if variant else "-"
            axes.plot(sizes[sizes > 0], values[sizes > 0], style, color=color, linewidth=1.2, label=label, **marker)
    axes.set_xscale("log", base=base)
    axes.set_xlabel("communication [bytes a frame]")
    _finish(figure, axes, title)
    return figure_png(figure)


def detections_picture(clouds: Sequence[FloatArray], truth: Boxes, boxes: Boxes, title: str) -> bytes:
    """All agents' points from above with ground-truth boxes (green) and detections (red), as in the paper.

    Args:
        clouds: of each agent, (N_i, 3 or more) x, y, z [m], all in the ego's frame.
        truth: what is there, in the ego's frame.
        boxes: what was detected, in the ego's frame.
        title: of the figure.
    """
    figure, axes = _map([truth, boxes])
    style_bev(axes, title)
    for cloud in clouds:
        draw_points(axes, np.asarray(cloud, dtype=np.float32))
    draw_boxes(axes, truth, _TRUE_BOX, label="truth", linewidth=1.6)
    draw_boxes(axes, boxes, _DETECTION, label="detected", filled=False, linewidth=1.6, zorder=4.0)
    draw_agent(axes, "black", label="ego")
    legend_below(figure)
    return figure_png(figure)


def matching_picture(ego: Boxes, other: Boxes, alignment: Alignment) -> bytes:
    """The detections of two agents in the ego frame by the estimated pose, with lines between matched objects.

    Args:
        ego: M boxes in the ego's frame.
        other: N boxes in the other's frame.
        alignment: what was found, or a refusal: the picture then says why, and shows the ego's boxes.
    """
    moved = Boxes.empty() if alignment.ego_SE2_other is None else other.transform(alignment.ego_SE2_other)
    figure, axes = _map([ego, moved])
    draw_together(axes, ego, other, alignment)
    legend_below(figure)
    return figure_png(figure)


def _map(shown: Sequence[Boxes]) -> tuple[Figure, Axes]:
    """A figure with one plot whose limits contain all boxes and the ego."""
    corners = np.concatenate([np.zeros((1, 2)), *(boxes.bev_corners().reshape(-1, 2) for boxes in shown)])
    (x_min, y_min), (x_max, y_max) = corners.min(axis=0) - 5.0, corners.max(axis=0) + 5.0
    figure = new_figure(
        12.0, min(max(12.0 * (y_max - y_min) / (x_max - x_min), 3.0), 12.0) + 1.2
    )  # with title, axis and legend
    (axes,) = add_axes(figure, 1, 1)
    axes.set_xlim(x_min, x_max)
    axes.set_ylim(y_min, y_max)
    return figure, axes


def _styles(names: Sequence[str]) -> list[dict[str, Any]]:
    """The line style of each method."""
    styles: list[dict[str, Any]] = []
    drawn = 0
    for name in names:
        if is_cobevglue(name):
            styles.append({"color": MATCH, "linewidth": 3.2, "marker": "*", "markersize": 13.0, "zorder": 4.0})
        elif name.casefold().startswith(_EGO_ONLY):
            styles.append({"color": "black", "linewidth": 2.0, "linestyle": "--", "zorder": 3.5})
        elif name.casefold().startswith("true pose"):
            styles.append({"color": TRUTH, "linewidth": 2.0, "linestyle": ":", "zorder": 3.5})
        else:
            color, marker = _COLORS[drawn % len(_COLORS)], _MARKERS[drawn % len(_MARKERS)]
            styles.append({"color": color, "linewidth": 1.4, "marker": marker, "markersize": 5.5, "zorder": 3.0})
            drawn += 1
    return styles


def _family(label: str) -> str:
    return label.split(",")[0] if "," in label else label.split(" ")[0]


def _finish(figure: Figure, axes: Axes, title: str, order: Sequence[str] | None = None) -> None:
    """Set title and grid, and the legend beside the plot in this order of names."""
    set_title(axes, title)
    axes.set_ylabel("average precision")
    light_grid(axes)
    handles, names = axes.get_legend_handles_labels()
    wanted = list(names if order is None else order)
    if wanted:
        figure.legend([handles[names.index(n)] for n in wanted], wanted, loc="outside right upper", frameon=False)
