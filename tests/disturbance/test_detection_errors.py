"""The detector model: each level does what its name says, alone, and the same seed gives the same bytes."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from pydantic import ValidationError

from cobevglue.boxes import Boxes
from cobevglue.disturbance.detection_errors import DetectionErrors, add_detection_errors
from cobevglue.se2 import wrap_angle

NONE = DetectionErrors.none()


def ring(n: int, distance: float = 20.0, label: bool = True) -> Boxes:
    """`n` cars on a circle around the agent."""
    angle = np.linspace(-np.pi, np.pi, n, endpoint=False)
    return Boxes(
        center=np.column_stack([distance * np.cos(angle), distance * np.sin(angle), np.full(n, -1.0)]),
        size=np.tile([4.5, 1.9, 1.6], (n, 1)),
        yaw=angle,
        track_id=np.arange(n) + 100,
        label=np.full(n, "van") if label else None,
    )


def detect(boxes: Boxes, seed: int = 0, **levels: Any) -> tuple[Boxes, np.ndarray]:
    errors = NONE.model_copy(update=levels)
    return add_detection_errors(boxes, errors, np.random.default_rng([seed, 0, 0]))


def test_perfect_detector_returns_truth_with_scores() -> None:
    boxes = ring(9)
    found, rows = detect(boxes)
    assert sorted(rows) == list(range(9))
    np.testing.assert_array_equal(found.center, boxes.center[rows])
    np.testing.assert_array_equal(found.size, boxes.size[rows])
    np.testing.assert_allclose(wrap_angle(found.yaw - boxes.yaw[rows]), 0.0, atol=1e-12)
    assert found.score is not None
    assert found.track_id is None
    assert found.label is not None
    assert set(found.label) == {"van"}


@pytest.mark.parametrize(
    ("levels", "error_of", "expected", "why"),
    [
        ({"center_std": 0.5}, "x", 0.5, "x is displaced by center_std"),
        ({"center_std": 0.5}, "y", 0.5, "y is displaced by center_std"),
        ({"center_std": 0.5}, "z", 0.0, "z has its own level"),
        ({"center_std_per_m": 0.01}, "x", 0.2, "at 20 m, 0.01 per metre is 0.2 m"),
        ({"center_std": 0.1, "center_std_per_m": 0.01}, "x", 0.3, "the growth is added to the level at the origin"),
        ({"z_std": 0.3}, "z", 0.3, "z_std moves z"),
        ({"z_std": 0.3}, "x", 0.0, "and only z"),
        ({"yaw_std": 0.1}, "yaw", 0.1, "yaw_std turns"),
        ({"size_std": (0.3, 0.0, 0.0)}, "l", 0.3, "the first of size_std is the length"),
        ({"size_std": (0.3, 0.0, 0.0)}, "w", 0.0, "the width has its own"),
        ({"size_std": (0.0, 0.2, 0.0)}, "w", 0.2, "the second is the width"),
        ({"size_std": (0.0, 0.0, 0.2)}, "h", 0.2, "the third is the height"),
    ],
)
def test_each_level_is_its_error_standard_deviation(
    levels: dict[str, Any], error_of: str, expected: float, why: str
) -> None:
    boxes = ring(4000)
    found, rows = detect(boxes, **levels)
    shift, growth = found.center - boxes.center[rows], found.size - boxes.size[rows]
    error = {"x": shift[:, 0], "y": shift[:, 1], "z": shift[:, 2]}
    error |= {"l": growth[:, 0], "w": growth[:, 1], "h": growth[:, 2], "yaw": wrap_angle(found.yaw - boxes.yaw[rows])}
    assert error[error_of].std() == pytest.approx(expected, rel=0.05, abs=1e-9), why
    assert abs(error[error_of].mean()) <= 0.1 * expected + 1e-9, "errors have no bias"


def test_missed_is_the_share_of_undetected_objects() -> None:
    found, rows = detect(ring(4000), missed=0.25)
    assert len(found) / 4000 == pytest.approx(0.75, abs=0.03)
    assert len(set(rows)) == len(rows)


def test_flipped_is_the_share_of_reversed_headings() -> None:
    boxes = ring(4000)
    found, rows = detect(boxes, flipped=0.1)
    turn = np.abs(wrap_angle(found.yaw - boxes.yaw[rows]))
    assert set(np.round(turn, 9)) == {0.0, round(math.pi, 9)}
    assert (turn > 1).mean() == pytest.approx(0.1, abs=0.02)


def test_false_boxes_have_rate_range_and_lower_scores() -> None:
    counts, distances = [], []
    for seed in range(300):
        found, rows = detect(ring(3), seed=seed, false_per_frame=2.0, false_range=30.0)
        false = found[rows == -1]
        counts.append(len(false))
        distances.extend(np.hypot(*false.center[:, :2].T))
        assert false.score is not None
        assert false.label is None or set(false.label) <= {"car"}
        assert (false.score < 0.5).all()
        assert (false.center[:, 2] == -1.0).all(), "false boxes stand where the true ones stand"
    assert np.mean(counts) == pytest.approx(2.0, abs=0.3)
    assert max(distances) <= 30.0
    assert np.mean(np.array(distances) < 30.0 / math.sqrt(2)) == pytest.approx(0.5, abs=0.06), "even over the area"


def test_detections_are_sorted_by_score() -> None:
    found, _ = detect(ring(50), false_per_frame=5.0, score_std=0.2)
    assert found.score is not None
    assert (np.diff(found.score) <= 0).all()
    assert ((found.score >= 0.05) & (found.score <= 1.0)).all()


def test_sizes_stay_valid_and_unknown_heights_unknown() -> None:
    boxes = ring(500).replace(size=np.tile([0.5, 0.3, 0.0], (500, 1)))
    found, _ = detect(boxes, size_std=(1.0, 1.0, 1.0))
    assert (found.size[:, :2] > 0).all()
    assert (found.size[:, 2] == 0).all()


def test_same_seed_gives_same_bytes() -> None:
    first, rows = add_detection_errors(ring(20), DetectionErrors(), np.random.default_rng([1, 2, 3]))
    again, rows_again = add_detection_errors(ring(20), DetectionErrors(), np.random.default_rng([1, 2, 3]))
    other, _ = add_detection_errors(ring(20), DetectionErrors(), np.random.default_rng([1, 2, 4]))
    assert first.center.tobytes() == again.center.tobytes()
    assert rows.tobytes() == rows_again.tobytes()
    assert first.center.tobytes() != other.center.tobytes()


def test_levels_are_independent_for_the_same_seed() -> None:
    few, few_rows = detect(ring(30), center_std=0.3, missed=0.5)
    all_, all_rows = detect(ring(30), center_std=0.3, missed=0.0, flipped=0.5)
    by_row = dict(zip(all_rows.tolist(), all_.center.tolist(), strict=True))
    assert [by_row[row] for row in few_rows.tolist()] == few.center.tolist()


@pytest.mark.parametrize("label", [True, False])
def test_an_empty_frame_gives_only_false_boxes(label: bool) -> None:
    found, rows = detect(ring(0, label=label), false_per_frame=6.0)
    assert len(found) > 0
    assert (rows == -1).all()
    assert (found.label is not None) == label


def test_nothing_in_and_no_errors_is_nothing_out() -> None:
    found, rows = detect(Boxes.empty())
    assert len(found) == 0
    assert rows.shape == (0,)
    assert rows.dtype == np.int64
    assert found.score is not None, "a detector's output has scores, also when it is empty"


@pytest.mark.parametrize(
    ("levels", "field"),
    [
        ({"center_std": -0.1}, "center_std"),
        ({"missed": 1.5}, "missed"),
        ({"flipped": -0.1}, "flipped"),
        ({"yaw_std": math.nan}, "yaw_std"),
        ({"size_std": (0.1, 0.1)}, "size_std"),
        ({"false_range": math.inf}, "false_range"),
        ({"centre_std": 0.1}, "centre_std"),
    ],
)
def test_invalid_level_is_named(levels: dict[str, Any], field: str) -> None:
    with pytest.raises(ValidationError, match=field):
        DetectionErrors(**levels)
