"""The figures of a study: what is drawn is what was given."""

from __future__ import annotations

import math
from io import BytesIO

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure
from PIL import Image

from cobevglue import SE2, Alignment, Boxes
from cobevglue.typing import FloatArray
from cobevglue.visualization import study_figures
from cobevglue.visualization.style import figure_png

LEVELS = ["0 m", "1 m", "2 m"]


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[Figure]:
    """The figures that are turned into PNG files from now on."""
    figures: list[Figure] = []

    def watched(figure: Figure) -> bytes:
        figures.append(figure)
        return figure_png(figure, dpi=40)

    monkeypatch.setattr(study_figures, "figure_png", watched)
    return figures


def legend(figure: Figure) -> list[str]:
    return [text.get_text() for box in figure.legends for text in box.get_texts()]


def cars(*x: float) -> Boxes:
    return Boxes([(v, 2.0, 0.0) for v in x], [(4.0, 2.0, 1.5)] * len(x), [0.0] * len(x))


def is_picture(png: bytes) -> bool:
    with Image.open(BytesIO(png)) as picture:
        low, high = picture.convert("L").getextrema()
    return low != high


def test_each_method_is_a_line_over_the_levels(figures: list[Figure]) -> None:
    curves = {"ego only": [0.7] * 3, "late": [0.9, 0.6, 0.2], "V2X-ViT": [0.9, 0.8, math.nan], "CoBEVGlue": [0.8] * 3}
    assert is_picture(study_figures.ap_over_noise(LEVELS, curves, "AP"))
    (axes,) = figures[0].axes
    lines = {str(line.get_label()): line for line in axes.lines}
    assert list(lines) == list(curves)
    for name, values in curves.items():
        np.testing.assert_array_equal(np.asarray(lines[name].get_ydata(), dtype=float), values)
    assert [label.get_text() for label in axes.get_xticklabels()] == LEVELS


def test_cobevglue_is_highlighted_and_legend_sorted(figures: list[Figure]) -> None:
    curves = {"No collaboration": [0.7] * 3, "late": [0.9, 0.6, 0.2], "lost": [math.nan] * 3, "CoBEVGlue": [0.8] * 3}
    study_figures.ap_over_noise(LEVELS, curves, "AP")
    lines = {str(line.get_label()): line for line in figures[0].axes[0].lines}
    assert lines["CoBEVGlue"].get_linewidth() > max(lines[n].get_linewidth() for n in curves if n != "CoBEVGlue")
    assert [n for n in curves if lines[n].get_linestyle() == "--"] == ["No collaboration"]
    assert legend(figures[0]) == ["CoBEVGlue", "No collaboration", "late", "lost"]


def test_a_curve_of_another_length_is_refused() -> None:
    with pytest.raises(ValueError, match="curve 'late' has 2 values for 3 levels"):
        study_figures.ap_over_noise(LEVELS, {"late": [0.5, 0.4]}, "AP")


POINTS = [
    ("ICP, 0.5 m", 1e5, 0.8),
    ("ICP, 0.5 m", 1e4, 0.7),
    ("ICP, 2.5 m", 1e5, 0.4),
    ("FPFH + TEASER++", 1e6, 0.6),
    ("CoBEVGlue", 500.0, 0.9),
    ("ego only", 0.0, 0.65),
]


def test_same_label_is_a_line_sharing_colour(figures: list[Figure]) -> None:
    assert is_picture(study_figures.ap_over_bytes(POINTS, "AP"))
    (axes,) = figures[0].axes
    lines = {str(line.get_label()): line for line in axes.lines}
    assert np.asarray(lines["ICP, 0.5 m"].get_xdata()).tolist() == [1e4, 1e5]
    assert np.asarray(lines["ICP, 0.5 m"].get_ydata()).tolist() == [0.7, 0.8]
    colors = {label: line.get_color() for label, line in lines.items()}
    assert colors["ICP, 0.5 m"] == colors["ICP, 2.5 m"]
    assert len(set(colors.values())) == 4
    assert axes.get_xscale() == "log"


def test_what_sends_nothing_is_a_horizontal_line(figures: list[Figure]) -> None:
    study_figures.ap_over_bytes(POINTS, "AP")
    line = next(line for line in figures[0].axes[0].lines if line.get_label() == "ego only (nothing sent)")
    assert np.asarray(line.get_ydata()).tolist() == [0.65, 0.65]


@pytest.mark.parametrize("clouds", [[], [np.zeros((0, 4))], [np.ones((50, 4)), np.zeros((5, 3))]])
@pytest.mark.parametrize("n", [0, 3])
def test_truth_and_detections_are_drawn_whatever_is_missing(
    figures: list[Figure], clouds: list[FloatArray], n: int
) -> None:
    png = study_figures.detections_picture(clouds, cars(*range(n)), cars(*range(2 * n)), "title")
    assert is_picture(png)
    boxes = [c for c in figures[0].axes[0].collections if isinstance(c, PolyCollection)]
    assert {str(c.get_label()): len(c.get_paths()) for c in boxes} == {"truth": n, "detected": 2 * n}


def test_matching_picture_moves_other_boxes_by_pose(figures: list[Figure]) -> None:
    pose, ego = SE2(10.0, -5.0, 0.7), cars(0.0, 10.0, 30.0)
    matches = np.column_stack([np.arange(3), np.arange(3)])
    assert is_picture(
        study_figures.matching_picture(ego, ego.transform(pose.inverse()), Alignment(pose, matches, np.eye(3)))
    )
    boxes = {str(c.get_label()): c for c in figures[0].axes[0].collections if isinstance(c, PolyCollection)}
    for label in ("boxes of ego", "boxes of other"):
        corners = [np.asarray(path.vertices)[:4] for path in boxes[label].get_paths()]
        np.testing.assert_allclose(corners, ego.bev_corners(), atol=1e-9)


def test_a_refusal_is_a_picture_too(figures: list[Figure]) -> None:
    assert is_picture(study_figures.matching_picture(cars(3.0), cars(4.0), Alignment.refused("too few in common")))
    assert "too few in common" in {text.get_text() for text in figures[0].axes[0].texts}
