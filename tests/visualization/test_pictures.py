"""Pictures: what is drawn is what was given, and nothing is global."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.figure import Figure

from cobevglue import SE2, Alignment, Boxes
from cobevglue.visualization import (
    add_axes,
    draw_alignment,
    draw_boxes,
    draw_object_graph,
    new_figure,
    save_figure,
)

EGO_SE2_OTHER = SE2(10.0, -5.0, 0.7)


def some_boxes(n: int, seed: int = 0) -> Boxes:
    rng = np.random.default_rng([seed, n])
    center = np.column_stack([rng.uniform(-50, 50, (n, 2)), np.zeros(n)])
    return Boxes(center, np.tile([4.5, 1.9, 1.5], (n, 1)), rng.uniform(-3, 3, n))


def render(figure: Figure) -> None:
    figure.canvas.draw()


def texts(figure: Figure) -> set[str]:
    return {text.get_text() for axes in figure.axes for text in axes.texts}


@pytest.mark.parametrize("n", [0, 1, 5])
def test_box_is_footprint_with_heading_line(n: int) -> None:
    (axes,) = add_axes(new_figure(4, 4), 1, 1)
    boxes = some_boxes(n)
    draw_boxes(axes, boxes, "black")
    outline, nose = axes.collections
    assert isinstance(outline, PolyCollection)
    assert isinstance(nose, LineCollection)
    footprints = [np.asarray(path.vertices)[:4] for path in outline.get_paths()]
    np.testing.assert_allclose(np.reshape(footprints, (n, 4, 2)), boxes.bev_corners())
    ends = np.reshape([np.asarray(path.vertices) for path in nose.get_paths()], (n, 2, 2))
    ahead = 2.25 * np.column_stack([np.cos(boxes.yaw), np.sin(boxes.yaw)])
    np.testing.assert_allclose(ends[:, 1] - ends[:, 0], ahead)


@pytest.mark.parametrize(("n", "common", "edges"), [(0, 0, 0), (1, 1, 0), (6, 3, 15), (20, 10, 190)])
def test_small_object_graph_is_complete(n: int, common: int, edges: int) -> None:
    (axes,) = add_axes(new_figure(4, 4), 1, 1)
    draw_object_graph(axes, some_boxes(n), "black", common=np.arange(common))
    all_edges, subgraph = (c for c in axes.collections[:2] if isinstance(c, LineCollection))
    assert len(all_edges.get_paths()) == edges
    assert len(subgraph.get_paths()) == common * (common - 1) // 2


def test_large_object_graph_has_nearest_edges_only() -> None:
    (axes,) = add_axes(new_figure(4, 4), 1, 1)
    draw_object_graph(axes, some_boxes(60), "black")
    assert 60 * 4 / 2 <= len(axes.collections[0].get_paths()) <= 60 * 4


@pytest.mark.parametrize("n", [2, 8, 40])
def test_alignment_has_three_plots_with_matched_numbers(n: int) -> None:
    ego = some_boxes(n)
    other = ego.transform(EGO_SE2_OTHER.inverse())
    alignment = Alignment(EGO_SE2_OTHER, np.column_stack([np.arange(n), np.arange(n)]), np.eye(3))
    figure = draw_alignment(ego, other, alignment)
    render(figure)
    assert len(figure.axes) == 3
    left, middle, right = ([text.get_text() for text in axes.texts] for axes in figure.axes)
    assert left == middle
    assert sorted(map(int, left)) == list(range(1, min(n, 12) + 1))
    assert "x 10.0 m, y -5.0 m, yaw 40.1°" in figure.axes[2].get_title(loc="left")
    rings = [c for c in figure.axes[2].collections if isinstance(c, PathCollection) and c.get_label() == "seen by both"]
    np.testing.assert_allclose(np.asarray(rings[0].get_offsets()), ego.center[:, :2], atol=1e-9)
    assert right == []


@pytest.mark.parametrize(("m", "n"), [(0, 0), (0, 3), (4, 3)])
def test_refusal_shows_reason_without_moved_boxes(m: int, n: int) -> None:
    figure = draw_alignment(some_boxes(m), some_boxes(n, seed=1), Alignment.refused("too few objects in common"))
    render(figure)
    assert "too few objects in common" in texts(figure)
    assert "Refused" in figure.axes[2].get_title(loc="left")


@pytest.mark.parametrize("ending", ["png", "svg", "pdf", "PNG"])
def test_the_ending_says_the_format(ending: str, tmp_path: Path) -> None:
    path = save_figure(draw_alignment(some_boxes(3), some_boxes(3), Alignment.refused("no")), tmp_path / f"a.{ending}")
    start = {"png": b"\x89PNG", "svg": b"<?xml", "pdf": b"%PDF"}[ending.lower()]
    assert path.read_bytes().startswith(start)


@pytest.mark.parametrize("name", ["picture", "picture.doc"])
def test_an_unknown_format_is_refused(name: str, tmp_path: Path) -> None:
    with pytest.raises(ValueError, match=r"must end with one of .*\.png"):
        save_figure(new_figure(1, 1), tmp_path / name)
    assert not list(tmp_path.iterdir())


def test_pyplot_is_not_imported() -> None:
    code = "import sys, cobevglue.visualization.demo_report; sys.exit('matplotlib.pyplot' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code], timeout=60, check=False).returncode == 0
