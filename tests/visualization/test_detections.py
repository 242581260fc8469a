"""Pictures of detections: every box is drawn once, as what it is."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from matplotlib.collections import PolyCollection
from matplotlib.figure import Figure

from cobevglue import Boxes
from cobevglue.evaluation.detection import DetectionFrame
from cobevglue.typing import Float32Array
from cobevglue.visualization import draw_detections, save_figure

CLOUD: Float32Array = np.random.default_rng(0).uniform(-30.0, 30.0, (1000, 4)).astype(np.float32)


def cars(*x: float, score: list[float] | None = None) -> Boxes:
    return Boxes([(v, 0.0, 0.0) for v in x], [(4.0, 2.0, 1.5)] * len(x), [0.0] * len(x), score=score)


def drawn(figure: Figure) -> dict[str, int]:
    """How many boxes there are of each kind."""
    (axes,) = figure.axes
    boxes = [c for c in axes.collections if isinstance(c, PolyCollection)]
    return {str(c.get_label()): len(c.get_paths()) for c in boxes if len(c.get_paths())}


def test_every_box_is_drawn_as_what_it_is() -> None:
    # Found at 10; missed at 20; ignored and found at -20; a false one at -10; one that is not sure enough at 20.
    detections = cars(10.0, -20.0, -10.0, 20.0, score=[0.95, 0.8, 0.7, 0.1])
    frame = DetectionFrame(detections, cars(10.0, 20.0, -20.0), np.array([9, 9, 0]), "s/7", "car1")
    figure = draw_detections(frame, CLOUD, min_points=1)
    assert drawn(figure) == {
        "object, found": 1,
        "object, missed": 1,
        "object, ignored": 1,
        "detection, true": 1,
        "detection, false": 1,
        "detection, of an ignored object": 1,
    }
    (axes,) = figure.axes
    assert {text.get_text() for text in axes.texts} == {".95", ".80", ".70"}
    assert axes.get_title(loc="left") == "s/7 car1: 1 of 2 objects found, 1 false at IoU 0.5, score 0.3"


def test_only_the_range_is_shown() -> None:
    frame = DetectionFrame(cars(10.0, 90.0, score=[1.0, 0.9]), cars(10.0, 90.0))
    figure = draw_detections(frame, CLOUD, evaluation_range=(-50.0, 40.0, -20.0, 30.0))
    assert drawn(figure)["detection, true"] == 1
    assert figure.axes[0].get_xlim() == (-50.0, 40.0)
    assert figure.axes[0].get_ylim() == (-20.0, 30.0)
    assert drawn(draw_detections(frame, CLOUD))["detection, true"] == 2  # without a range everything is


@pytest.mark.parametrize("cloud", [CLOUD, CLOUD[:0]], ids=["a cloud", "no points"])
@pytest.mark.parametrize("n", [0, 3], ids=["no objects", "objects"])
def test_whatever_is_missing_there_is_a_picture(cloud: Float32Array, n: int, tmp_path: Path) -> None:
    x = [10.0 * i for i in range(n)]
    for detections in (Boxes.empty(), cars(*x, score=[0.5] * n)):
        path = save_figure(draw_detections(DetectionFrame(detections, cars(*x)), cloud), tmp_path / "picture.png")
        assert path.stat().st_size > 0
