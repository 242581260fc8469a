"""Boxes and object graphs seen from above."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection, PolyCollection

from cobevglue.boxes import Boxes
from cobevglue.typing import ArrayLike, FloatArray, IntArray
from cobevglue.visualization.style import MATCH

__all__ = ["draw_agent", "draw_boxes", "draw_object_graph", "draw_pairs"]

_NODE_SIZE = 14.0  # [points squared]
_BADGE_OFFSET = 11.0  # of a name from its object [points]
_ALL_EDGES_UP_TO, _NEAR_EDGES = 24, 4
"""A graph of more nodes is drawn with the edges to this many nearest nodes only."""


def draw_boxes(
    axes: Axes,
    boxes: Boxes,
    color: str,
    *,
    label: str | None = None,
    filled: bool = True,
    linewidth: float = 1.3,
    linestyle: str = "-",
    alpha: float = 1.0,
    zorder: float = 2.0,
) -> None:
    """Draw the footprints of boxes, each with a line from its centre to its front.

    Args:
        axes: the plot, in the frame of the boxes.
        boxes: N boxes.
        color: of outline and filling.
        label: what the legend calls them.
        filled: fill the footprints, lightly.
        linewidth: of the outlines [points].
        linestyle: of the outlines, as matplotlib names them.
        alpha: opacity, 0 to 1.
        zorder: what is higher is drawn over what is lower.
    """
    corners = boxes.bev_corners()
    outline = PolyCollection(
        list(corners),
        facecolors=(color, 0.25 * alpha) if filled else "none",
        edgecolors=(color, alpha),
        linewidths=linewidth,
        linestyles=linestyle,
        label=label,
        zorder=zorder,
    )
    axes.add_collection(outline)
    front = (corners[:, 0] + corners[:, 3]) / 2.0
    nose = np.stack([boxes.center[:, :2], front], axis=1)
    axes.add_collection(LineCollection(list(nose), colors=color, linewidths=linewidth, alpha=alpha, zorder=zorder))
    axes.autoscale_view()


def draw_object_graph(
    axes: Axes,
    boxes: Boxes,
    color: str,
    *,
    common: ArrayLike | None = None,
    names: Sequence[str] | None = None,
    filled: bool = True,
    label: str | None = None,
) -> None:
    """Draw an object graph: a node for each object, edges between them, and the common subgraph highlighted.

    Any two nodes have an edge; where that would be too many to see anything, only those between near nodes are drawn.

    Args:
        axes: the plot, in the frame of the boxes.
        boxes: the N objects.
        color: of the nodes and of the edges outside the common subgraph.
        common: (K,) rows of the objects that another graph has too, None for no subgraph.
        names: (K,) what to write beside the common nodes, "" for nothing; so that two pictures can be compared.
        filled: fill the footprints.
        label: what the legend calls the objects.
    """
    rows: IntArray = np.zeros(0, dtype=np.int64) if common is None else np.asarray(common, dtype=np.int64)
    at = boxes.center[:, :2]
    axes.add_collection(LineCollection(list(_edges(at)), colors=color, linewidths=0.5, alpha=0.16, zorder=1.0))
    subgraph = LineCollection(list(_edges(at[rows])), colors=MATCH, linewidths=1.0, alpha=0.5, zorder=1.5)
    axes.add_collection(subgraph)
    draw_boxes(axes, boxes, color, label=label, filled=filled)
    axes.scatter(at[:, 0], at[:, 1], s=_NODE_SIZE, color=color, zorder=3.0)
    axes.scatter(at[rows, 0], at[rows, 1], s=_NODE_SIZE, color=MATCH, zorder=3.5)
    if names is not None:
        _draw_names(axes, at[rows], names)


def draw_agent(axes: Axes, color: str, *, x: float = 0.0, y: float = 0.0, yaw: float = 0.0, label: str = "") -> None:
    """Draw the pose of an agent as an arrow head.

    Args:
        axes: the plot.
        color: of the arrow head.
        x: forward [m].
        y: left [m].
        yaw: heading [rad].
        label: what the legend calls it.
    """
    marker: Any = (3, 0, np.degrees(yaw) - 90.0)  # a triangle, which points along +y unless turned
    axes.scatter([x], [y], s=170.0, marker=marker, color=color, edgecolors="black", zorder=5.0, label=label or None)


def draw_pairs(axes: Axes, ego: Boxes, moved: Boxes, label: str = "seen by both") -> None:
    """Draw a ring around each pair of matched boxes, and a line between their centres.

    Args:
        axes: the plot, in the ego's frame.
        ego: K boxes of the ego.
        moved: the K boxes of the other that they are matched with, in the ego's frame.
        label: what the legend calls the rings.
    """
    ends = np.stack([ego.center[:, :2], moved.center[:, :2]], axis=1)
    axes.add_collection(LineCollection(list(ends), colors=MATCH, linewidths=2.0, zorder=4.0))
    middle = ends.mean(axis=1)
    size = 330.0 if len(middle) <= _ALL_EDGES_UP_TO else 150.0
    axes.scatter(
        middle[:, 0], middle[:, 1], s=size, facecolors="none", edgecolors=MATCH, linewidths=1.6, zorder=4.0, label=label
    )


def _edges(at: FloatArray) -> FloatArray:
    """(E, 2, 2) ends of the edges between these points (N, 2): all, or those to the nearest if there are many."""
    first, second = np.triu_indices(len(at), k=1)
    if len(at) > _ALL_EDGES_UP_TO:
        distance = np.linalg.norm(at[:, None] - at[None], axis=-1)
        rank = np.argsort(np.argsort(distance, axis=1), axis=1)  # 0 is the node itself
        near = (rank <= _NEAR_EDGES) | (rank.T <= _NEAR_EDGES)
        first, second = first[near[first, second]], second[near[first, second]]
    return np.stack([at[first], at[second]], axis=1)


def _draw_names(axes: Axes, at: FloatArray, names: Sequence[str]) -> None:
    """Draw numbered green discs, each beside its point on the side away from the others."""
    outward = at - at.mean(axis=0) if len(at) else at
    outward = outward / np.maximum(np.hypot(outward[:, 0], outward[:, 1]), 1e-9)[:, None]
    for name, point, direction in zip(names, at, outward, strict=True):
        if not name:
            continue
        axes.annotate(
            name,
            point,
            xytext=_BADGE_OFFSET * direction,
            textcoords="offset points",
            color="white",
            fontsize=8.0,
            weight="bold",
            ha="center",
            va="center",
            zorder=4.0,
            bbox={"boxstyle": "circle,pad=0.18", "facecolor": MATCH, "edgecolor": "white", "linewidth": 0.8},
        )
