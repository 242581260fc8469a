"""The drive as something to play: an interactive picture for a report page, without a library or a network."""

from __future__ import annotations

import base64
import json
from pathlib import Path
from typing import Any

import numpy as np

from cobevglue.boxes import Boxes
from cobevglue.demo import ROWS, DemoFrame, DemoResult
from cobevglue.se2 import SE2
from cobevglue.typing import ArrayLike, Float32Array
from cobevglue.visualization.demo_pictures import lane_polygon, thinned

__all__ = ["player"]

_TEMPLATE = Path(__file__).with_name("demo_player.html")
_PLACE = "{{data}}"
_POINTS_AT_MOST = 1500  # of a cloud
_ROADS_WITHIN = 110.0  # of the ego [m]


def player(result: DemoResult) -> str:
    """HTML that plays the drive, seen from above, for each row of the comparison.

    The data are a JSON document inside: lengths in metres, angles in radians, clouds as int16 x, y [cm] in base64.
    Roads and the ego's poses are in the *scene's* frame, that of the ego in the story's moment, in which roads stand
    still. Boxes and the others' poses are in the ego's frame of the time, clouds in that of their agent.
    """
    story = result.story()
    scene_SE2_world = story.world_SE2_ego.inverse()
    areas = [lane_polygon(lane) for lane in result.roads.lanes] + [j.polygon for j in result.roads.junctions]
    areas = [scene_SE2_world.apply(area) for area in areas]
    data = {
        "rows": dict(ROWS),
        "start": story.index,
        "view": story.reach,
        "ego": story.ego,
        "roads": [_rounded(area) for area in areas if np.abs(area).min(axis=0).max() < _ROADS_WITHIN],
        "frames": [_frame(frame, scene_SE2_world) for frame in result.frames],
    }
    text = json.dumps(data, separators=(",", ":"), allow_nan=False).replace("<", "\\u003c")
    return _TEMPLATE.read_text(encoding="utf-8").replace(_PLACE, text)


def _frame(frame: DemoFrame, scene_SE2_world: SE2) -> dict[str, Any]:
    """What there is to draw of one frame."""
    scene_SE2_ego = scene_SE2_world @ frame.world_SE2_ego
    return {
        "time": round(frame.time, 2),
        "ego": _pose(scene_SE2_ego),
        "vehicles": _boxes(frame.truth[frame.counted]),
        "hidden": frame.hidden[frame.counted].astype(int).tolist(),
        "clouds": {name: _cloud(points) for name, points in frame.points.items()},
        "rows": {row: _row(frame, row) for row in ROWS},
    }


def _row(frame: DemoFrame, row: str) -> dict[str, Any]:
    verdict = frame.verdict(row)
    errors = [round(metres, 2) for metres, _ in frame.pose_errors(row)]
    return {
        "others": {name: _pose(pose) for name, pose in frame.used_poses(row).items()},
        "errors": dict(zip(frame.used_poses(row), errors, strict=True)),
        "found": verdict.found[frame.counted].astype(int).tolist(),
        "ghosts": _boxes(verdict.boxes[verdict.ghost]),
    }


def _pose(pose: SE2) -> list[float]:
    return [round(pose.x, 2), round(pose.y, 2), round(pose.yaw, 4)]


def _boxes(boxes: Boxes) -> list[list[float]]:
    """x, y, length, width, yaw of each."""
    return _rounded(boxes.bev)


def _rounded(values: ArrayLike) -> list[list[float]]:
    rounded: list[list[float]] = np.round(np.asarray(values, dtype=np.float64), 2).tolist()
    return rounded


def _cloud(points: Float32Array) -> str:
    at = thinned(points)
    at = at[:: max(1, -(-len(at) // _POINTS_AT_MOST))]
    return base64.b64encode(np.round(100.0 * at).astype("<i2").tobytes()).decode("ascii")
