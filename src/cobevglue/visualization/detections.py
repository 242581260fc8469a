"""Detections in a cloud: true positives, false positives and missed objects."""

from __future__ import annotations

import math

import numpy as np
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from cobevglue.boxes import Boxes
from cobevglue.evaluation.detection_matching import DROPPED, FALSE, DetectionFrame, EvaluationRange, match, prepare
from cobevglue.typing import Float32Array, IntArray
from cobevglue.visualization.bev import draw_agent, draw_boxes
from cobevglue.visualization.style import (
    EGO,
    GIVEN_POSE,
    MATCH,
    OTHER,
    TRUTH,
    add_axes,
    legend_below,
    new_figure,
    style_bev,
)

__all__ = ["draw_detections", "draw_points"]

_WIDTH = 16.0  # of the picture [inches]
_POINTS_AT_MOST = 120_000
_FLOOR, _CEILING = -2.5, 1.5
"""Range of heights above the LiDAR for the grey values of points, from light to dark [m]."""


def draw_detections(
    frame: DetectionFrame,
    points: Float32Array,
    *,
    threshold: float = 0.5,
    score_threshold: float = 0.3,
    evaluation_range: EvaluationRange | None = None,
    min_points: int = 0,
    title: str = "",
) -> Figure:
    """Draw a cloud from above with ground-truth boxes and detections, coloured by whether they are matched.

    A line from a box's centre to its front shows its heading; numbers are scores. What counts and what matches is as
    in `cobevglue.evaluation.detection_matching`; ignored objects are dotted.

    Args:
        frame: detections and truth in the agent's LiDAR frame.
        points: (N, 4) x, y, z [m], intensity; the same frame.
        threshold: least IoU of a true detection.
        score_threshold: detections scored lower are not drawn.
        evaluation_range: part of the map that is drawn and counts; left out, all that there is.
        min_points: objects with fewer points are ignored.
        title: of the picture; the frame's name and agent, and what was found, where left out.
    """
    scene = prepare(frame, evaluation_range, min_points)
    found = match(scene, threshold)
    found[scene.score < score_threshold] = DROPPED
    sure = scene.score >= score_threshold
    is_found = np.isin(np.arange(len(scene.truth)), found)
    true, false, dropped = (sure & mask for mask in (found >= 0, found == FALSE, found == DROPPED))
    missed = scene.counted & ~is_found
    x_min, x_max, y_min, y_max = evaluation_range or _extent(points, frame)
    figure = new_figure(_WIDTH, _WIDTH * min(max((y_max - y_min) / (x_max - x_min), 0.15), 1.0) + 1.2)
    (axes,) = add_axes(figure, 1, 1)
    style_bev(axes, title or _title(frame, scene.counted.sum(), true.sum(), false.sum(), threshold, score_threshold))
    draw_points(axes, points)
    draw_agent(axes, "black")
    draw_boxes(axes, scene.truth[is_found], TRUTH, label="object, found", linewidth=1.6)
    draw_boxes(axes, scene.truth[missed], OTHER, label="object, missed", linewidth=1.6, zorder=3.0)
    draw_boxes(axes, scene.truth[~scene.counted], TRUTH, label="object, ignored", linestyle=":", filled=False)
    for rows, color, label in (
        (true, EGO, "detection, true"),
        (false, GIVEN_POSE, "detection, false"),
        (dropped, MATCH, "detection, of an ignored object"),
    ):
        draw_boxes(axes, scene.detections[rows], color, label=label, filled=False, linewidth=1.2, zorder=4.0)
        _draw_scores(axes, scene.detections[rows], color)
    axes.set_xlim(x_min, x_max)
    axes.set_ylim(y_min, y_max)
    legend_below(figure)
    return figure


def draw_points(axes: Axes, points: Float32Array) -> None:
    """Draw a cloud from above as dots that are darker the higher they are; large clouds are subsampled.

    Args:
        axes: the plot, in the frame of the points.
        points: (N, 3 or more) x, y, z [m].
    """
    points = points[:: max(1, math.ceil(len(points) / _POINTS_AT_MOST))]
    points = points[np.argsort(points[:, 2], kind="stable")]  # high ones over low ones
    height = np.clip((points[:, 2] - _FLOOR) / (_CEILING - _FLOOR), 0.0, 1.0)
    axes.scatter(
        points[:, 0],
        points[:, 1],
        s=0.7,
        c=colormaps["Greys"](0.25 + 0.6 * height),
        linewidths=0.0,
        zorder=1.0,
        rasterized=True,
    )


def _draw_scores(axes: Axes, boxes: Boxes, color: str) -> None:
    """Write scores without the leading zero beside the left-most corners of boxes, where they fit into the picture."""
    corners = boxes.bev_corners()
    for row, score in enumerate(boxes.score if boxes.score is not None else ()):
        x, y = corners[row, corners[row, :, 1].argmax()]
        text = f"{score:.2f}".removeprefix("0")
        axes.annotate(
            text, (x, y), xytext=(1, 1), textcoords="offset points", color=color, fontsize=6.5, clip_on=True, zorder=6.0
        )


def _extent(points: Float32Array, frame: DetectionFrame) -> EvaluationRange:
    """The extent of the boxes, the agent and nearly all points [m]."""
    near = np.quantile(points[:, :2], [0.005, 0.995], axis=0) if len(points) else np.zeros((2, 2))
    places = np.concatenate([near, frame.truth.center[:, :2], frame.detections.center[:, :2], np.zeros((1, 2))])
    (x_min, y_min), (x_max, y_max) = places.min(axis=0) - 5.0, places.max(axis=0) + 5.0
    return float(x_min), float(x_max), float(y_min), float(y_max)


def _title(
    frame: DetectionFrame, objects: IntArray, true: IntArray, false: IntArray, threshold: float, score: float
) -> str:
    where = " ".join(part for part in (frame.name, frame.agent) if part)
    what = f"{true} of {objects} objects found, {false} false at IoU {threshold:g}, score {score:g}"
    return f"{where}: {what}" if where else what
