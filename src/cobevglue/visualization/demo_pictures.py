"""The pictures of the demo: one frame by each method, and the matched objects of two cars."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from cobevglue.demo import COBEVGLUE, EGO_ONLY, ROWS, DemoFrame, DemoResult
from cobevglue.se2 import SE2
from cobevglue.simulation.road_network import Lane, RoadNetwork
from cobevglue.typing import Float32Array, FloatArray
from cobevglue.visualization.alignment import draw_alignment
from cobevglue.visualization.bev import draw_agent, draw_boxes
from cobevglue.visualization.style import (
    EGO,
    MATCH,
    OTHER,
    add_axes,
    legend_below,
    new_figure,
    style_bev,
)

__all__ = ["draw_comparison", "draw_moment", "draw_pose", "lane_polygon", "thinned", "witness"]

_VIEW = (-62.0, 62.0, -39.0, 39.0)  # x_min, x_max, y_min, y_max of the ego's surroundings that are shown [m]
_ROAD, _HIDDEN, _GHOST = "#ECEEF0", "#E69F00", "#D4002A"
_GROUND = -1.6  # points below this are left out of pictures [m]
_CELL = 0.4  # of the others, one in each square of this side is drawn [m]


def draw_comparison(
    result: DemoResult, rows: Sequence[str] = (EGO_ONLY, "noisy_gps", "attacked_gps", COBEVGLUE)
) -> Figure:
    """The key frame by several methods, two plots in a row.

    Args:
        result: the drive.
        rows: keys of `ROWS`.
    """
    lines = (len(rows) + 1) // 2
    figure = new_figure(14.0, 5.1 * lines + 0.7)
    for axes, row in zip(add_axes(figure, lines, 2), rows, strict=False):
        draw_moment(axes, result.story(), row, result.roads)
    legend_below(figure, columns=4)
    return figure


def draw_moment(axes: Axes, frame: DemoFrame, row: str, roads: RoadNetwork) -> None:
    """Ground truth, true and false detections in the ego frame.

    Args:
        axes: an empty plot.
        frame: the moment.
        row: a key of `ROWS`.
        roads: for orientation; the system does not know them.
    """
    verdict, truth = frame.verdict(row), frame.truth
    _draw_roads(axes, roads, frame)
    _draw_clouds(axes, frame, row)
    missed = frame.counted & ~verdict.found
    draw_boxes(axes, truth[missed], "black", label="missed", filled=False, linewidth=1.0, linestyle=":")
    draw_boxes(axes, truth[verdict.found & ~frame.hidden], EGO, label="found", linewidth=1.2)
    draw_boxes(axes, truth[verdict.found & frame.hidden], MATCH, label="found, hidden from the ego", linewidth=2.2)
    ghosts = verdict.boxes[verdict.ghost]
    draw_boxes(axes, ghosts, _GHOST, label="ghost: a box without a vehicle", linewidth=1.8, zorder=3.5)
    at = truth.center[frame.hidden]
    axes.scatter(
        at[:, 0], at[:, 1], s=420.0, facecolors="none", edgecolors=_HIDDEN, linewidths=1.5, label="hidden from the ego"
    )
    draw_agent(axes, EGO, label="the ego")
    for pose in frame.used_poses(row).values():
        draw_agent(axes, OTHER, x=pose.x, y=pose.y, yaw=pose.yaw)
    # A stand-in for the legend, which is in all plots, also where there are no others.
    axes.scatter([], [], s=120.0, marker=">", color=OTHER, edgecolors="black", label="another car, as it is placed")
    result = f"{verdict.found.sum()} of {frame.counted.sum()} found, {len(ghosts)} ghost{'s' * (len(ghosts) != 1)}"
    style_bev(axes, f"{ROWS[row][0].upper()}{ROWS[row][1:]}: {result}")
    x_min, x_max, y_min, y_max = _VIEW
    axes.set_xlim(x_min, x_max)
    axes.set_ylim(y_min, y_max)


def draw_pose(result: DemoResult) -> Figure:
    """The alignment of another car in the key frame: both object graphs and their common subgraph."""
    frame, name = result.story(), witness(result)
    alignment = frame.outputs[COBEVGLUE].alignments[name]
    ego, other = frame.tracked[frame.ego], frame.tracked[name]
    return draw_alignment(ego, other, alignment, ego_name=f"{frame.ego}, the ego", other_name=name)


def witness(result: DemoResult) -> str:
    """The agent nearest to the objects that are hidden from the ego in the key frame."""
    frame = result.story()
    movers = frame.hidden_movers
    at = frame.truth.center[movers[0], :2] if len(movers) else np.zeros(2)
    return min(frame.ego_SE2_others, key=lambda name: float(np.hypot(*(frame.ego_SE2_others[name].translation - at))))


def lane_polygon(lane: Lane) -> FloatArray:
    """(2 N, 2) outline of a lane with N points in the world frame."""
    along = np.gradient(lane.centerline, axis=0)
    along /= np.maximum(np.hypot(along[:, 0], along[:, 1]), 1e-9)[:, None]
    left = lane.width / 2.0 * np.column_stack([-along[:, 1], along[:, 0]])
    return np.concatenate([lane.centerline + left, (lane.centerline - left)[::-1]])


def thinned(points: Float32Array) -> Float32Array:
    """(M, 2) x and y of points above the ground, at most one in each cell of a fine grid."""
    above = points[points[:, 2] > _GROUND, :2]
    _, first = np.unique(np.floor(above / _CELL), axis=0, return_index=True)
    return above[np.sort(first)]


def _draw_roads(axes: Axes, roads: RoadNetwork, frame: DemoFrame) -> None:
    ego_SE2_world = frame.world_SE2_ego.inverse()
    areas = [lane_polygon(lane) for lane in roads.lanes] + [junction.polygon for junction in roads.junctions]
    polygons = PolyCollection([ego_SE2_world.apply(area) for area in areas], facecolors=_ROAD, zorder=0.4)
    axes.add_collection(polygons, autolim=False)


def _draw_clouds(axes: Axes, frame: DemoFrame, row: str) -> None:
    """The ego's points, and those of the others transformed by the ego's estimate of their poses."""
    clouds = [(frame.ego, SE2(), EGO), *((name, pose, OTHER) for name, pose in frame.used_poses(row).items())]
    for name, ego_SE2_agent, color in reversed(clouds):
        x, y = ego_SE2_agent.apply(thinned(frame.points[name])).T
        axes.scatter(x, y, s=0.9, color=color, alpha=0.6, linewidths=0.0, zorder=1.0, rasterized=True)
