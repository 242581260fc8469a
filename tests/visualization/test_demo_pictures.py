"""The demonstration's pictures and player: what is shown is what was found."""

from __future__ import annotations

import base64
import json
import re
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import PathCollection, PolyCollection

from cobevglue.demo import COBEVGLUE, ROWS, DemoResult, run_demo
from cobevglue.typing import Float32Array
from cobevglue.visualization import add_axes, new_figure
from cobevglue.visualization.demo_pictures import draw_comparison, draw_moment, draw_pose, lane_polygon, thinned
from cobevglue.visualization.demo_player import player


@pytest.fixture(scope="module")
def drive() -> DemoResult:
    return run_demo(0, frames=2)


@pytest.mark.parametrize("row", ROWS)
def test_every_vehicle_and_every_ghost_is_drawn_once(drive: DemoResult, row: str) -> None:
    frame = drive.story()
    (axes,) = add_axes(new_figure(6, 4), 1, 1)
    draw_moment(axes, frame, row, drive.roads)
    drawn = {str(c.get_label()): len(c.get_paths()) for c in axes.collections if isinstance(c, PolyCollection)}
    verdict = frame.verdict(row)
    assert drawn["missed"] + drawn["found"] + drawn["found, hidden from the ego"] == frame.counted.sum()
    assert drawn["found, hidden from the ego"] == (verdict.found & frame.hidden).sum()
    assert drawn["ghost: a box without a vehicle"] == verdict.ghost.sum()
    rings = [c for c in axes.collections if isinstance(c, PathCollection) and c.get_label() == "hidden from the ego"]
    assert np.asarray(rings[0].get_offsets()).shape == (frame.hidden.sum(), 2)
    title = axes.get_title(loc="left")
    assert f"{verdict.found.sum()} of {frame.counted.sum()} found, {verdict.ghost.sum()} ghost" in title


def test_comparison_has_one_plot_per_row(drive: DemoResult) -> None:
    titles = [axes.get_title(loc="left").split(":")[0] for axes in draw_comparison(drive).axes]
    assert titles == ["Ego only", "Fused on noisy GPS", "Fused under attack", "CoBEVGlue"]


def test_the_pose_is_drawn_as_three_plots(drive: DemoResult) -> None:
    assert len(draw_pose(drive).axes) == 3


def test_a_lane_is_as_wide_as_it_is(drive: DemoResult) -> None:
    lane = max(drive.roads.lanes, key=lambda lane: lane.length)
    outline = lane_polygon(lane)
    across = outline[: len(outline) // 2] - outline[len(outline) // 2 :][::-1]
    np.testing.assert_allclose(np.hypot(*across.T), lane.width)


def test_cloud_is_thinned_and_ground_removed() -> None:
    points: Float32Array = np.array(
        [[0.1, 0.1, 0.0, 0.5], [0.2, 0.3, 1.0, 0.5], [0.5, 0.1, 0.0, 0.5], [5.0, 5.0, -1.9, 0.5]], dtype=np.float32
    )
    np.testing.assert_allclose(thinned(points), [[0.1, 0.1], [0.5, 0.1]])


def data_of(html: str) -> dict[str, Any]:
    (text,) = re.findall(r'<script type="application/json">(.*?)</script>', html, flags=re.DOTALL)
    data: dict[str, Any] = json.loads(text)
    return data


def test_the_player_has_all_that_was_found(drive: DemoResult) -> None:
    html = player(drive)
    data = data_of(html)
    assert "{{" not in html
    assert data["rows"] == dict(ROWS)
    assert len(data["frames"]) == 2
    for shown, frame in zip(data["frames"], drive.frames, strict=True):
        np.testing.assert_allclose(shown["vehicles"], frame.truth[frame.counted].bev, atol=0.006)
        assert sum(shown["hidden"]) == frame.hidden.sum()
        for row in ROWS:
            verdict = frame.verdict(row)
            assert sum(shown["rows"][row]["found"]) == verdict.found.sum()
            assert len(shown["rows"][row]["ghosts"]) == verdict.ghost.sum()
            assert set(shown["rows"][row]["others"]) == set(frame.used_poses(row))


def test_player_clouds_are_in_centimetres(drive: DemoResult) -> None:
    shown = data_of(player(drive))["frames"][0]["clouds"]
    for name, points in drive.frames[0].points.items():
        at = np.frombuffer(base64.b64decode(shown[name]), dtype="<i2").reshape(-1, 2) / 100.0
        assert 100 < len(at) <= 1500
        gap = np.abs(at[:50, None] - points[None, :, :2]).max(axis=2).min(axis=1)
        assert gap.max() < 0.006


def test_the_scene_stands_still_in_the_story(drive: DemoResult) -> None:
    data = data_of(player(drive))
    assert data["frames"][data["start"]]["ego"] == [0.0, 0.0, 0.0]
    others = data["frames"][data["start"]]["rows"][COBEVGLUE]["others"]
    assert set(others) <= set(drive.story().ego_SE2_others)
