"""From what the head says to boxes."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from cobevglue.boxes import Boxes
from cobevglue.perception import AnchorGrid, DetectionConfig, HeadOutput
from cobevglue.perception.decode import decode
from cobevglue.typing import FloatArray

from .conftest import SMALL

GRID = AnchorGrid(SMALL)
N = len(GRID)
CAR = [0.4, 0.4, -1.0, 4.4, 2.0, 1.6, 0.0]
CELL = 4 * (12 * 32 + 16)
"""The first anchor of the cell at 0.4, 0.4."""


def said(*boxes: tuple[int, list[float], float, float]) -> HeadOutput:
    """A head that says (anchor, box, score, standard deviation of all three) and is sure of nothing else."""
    output = HeadOutput(torch.full((1, N), -20.0), torch.zeros(1, N, 7), torch.zeros(1, N, 2), torch.zeros(1, N, 3))
    for anchor, box, score, deviation in boxes:
        residuals, direction = GRID.encode(np.array([box]), [anchor])
        output.logits[0, anchor] = math.log(score / (1 - score))
        output.residuals[0, anchor] = torch.from_numpy(residuals[0])
        output.direction[0, anchor, int(direction[0])] = 5.0
        output.log_variance[0, anchor] = 2 * math.log(deviation)
    return output


def decoded(output: HeadOutput, **settings: float) -> tuple[Boxes, FloatArray]:
    ((boxes, variance, _),) = decode(output, GRID, DetectionConfig(**settings))  # type: ignore[arg-type]
    return boxes, variance


@pytest.mark.parametrize("yaw", [0.0, 0.5, 1.5, 2.5, 3.1, -0.5, -1.5, -2.5, -3.1])
def test_encoded_box_is_decoded_unchanged(yaw: float) -> None:
    boxes, variance = decoded(said((CELL, [*CAR[:6], yaw], 0.8, 0.3)))
    assert boxes.center.tolist() == [pytest.approx(CAR[:3], abs=1e-5)]
    assert boxes.size.tolist() == [pytest.approx(CAR[3:6], abs=1e-5)]
    assert boxes.yaw.tolist() == pytest.approx([yaw], abs=1e-5)
    assert boxes.score is not None
    assert boxes.label is not None
    assert boxes.score.tolist() == pytest.approx([0.8], abs=1e-5)
    assert boxes.label.tolist() == ["vehicle"]
    assert variance.tolist() == [pytest.approx([0.09] * 3, rel=1e-4)]


def test_nothing_said_is_no_boxes_with_scores() -> None:
    boxes, variance = decoded(said())
    assert len(boxes) == 0
    assert boxes.score is not None
    assert variance.shape == (0, 3)


FAR = [8.4, *CAR[1:]]
FAR_CELL = CELL + 4 * 10


@pytest.mark.parametrize(
    ("settings", "scores"),
    [
        ({}, [0.9, 0.6]),
        ({"score_threshold": 0.7}, [0.9]),
        ({"max_detections": 1}, [0.9]),
        ({"candidates": 1}, [0.9]),
        ({"nms_iou": 1.0}, [0.9, 0.8, 0.6]),
    ],
)
def test_nms_keeps_best_of_overlapping_boxes(settings: dict[str, float], scores: list[float]) -> None:
    near = [0.6, *CAR[1:]]
    output = said((CELL, CAR, 0.9, 0.2), (CELL + 4, near, 0.8, 0.2), (FAR_CELL, FAR, 0.6, 0.2))
    boxes, _ = decoded(output, **settings)
    assert boxes.score is not None
    assert boxes.score.tolist() == pytest.approx(scores, abs=1e-5)


def test_penalty_keeps_the_more_precise_box() -> None:
    near = [0.6, *CAR[1:]]
    output = said((CELL, CAR, 0.9, 1.0), (CELL + 4, near, 0.8, 0.1))
    assert decoded(output)[0].center[0, 0] == pytest.approx(0.4, abs=1e-5)
    boxes, variance = decoded(output, uncertainty_penalty=1.0)
    assert boxes.center[0, 0] == pytest.approx(0.6, abs=1e-5)
    assert boxes.score is not None
    assert boxes.score.tolist() == pytest.approx([0.8], abs=1e-5), "scores are handed out as they are"
    assert variance[0, 0] == pytest.approx(0.01, rel=1e-4)


def test_voting_moves_box_towards_more_precise_one() -> None:
    near = [0.6, *CAR[1:6], 0.1]
    output = said((CELL, CAR, 0.9, 0.5), (CELL + 4, near, 0.8, 0.05), (FAR_CELL, FAR, 0.6, 0.2))
    boxes, _ = decoded(output, variance_voting=True)
    assert 0.55 < boxes.center[0, 0] < 0.6
    assert 0.08 < boxes.yaw[0] < 0.1
    assert boxes.center[1] == pytest.approx(FAR[:3], abs=1e-5), "alone, nothing changes"
    assert boxes.size[0] == pytest.approx(CAR[3:6], abs=1e-5)


def test_a_flipped_voter_turns_nothing_round() -> None:
    flipped = [*CAR[:6], 3.1]
    output = said((CELL, CAR, 0.9, 0.2), (CELL + 4, flipped, 0.8, 0.2))
    boxes, _ = decoded(output, variance_voting=True)
    assert -0.05 < boxes.yaw[0] < 0.0


def test_confident_vote_flips_an_uncertain_heading() -> None:
    flipped = [*CAR[:6], math.pi]
    output = said((CELL, CAR, 0.9, 0.2), (CELL + 4, flipped, 0.8, 0.2))
    output.direction[0, CELL] *= 0.01
    boxes, _ = decoded(output, variance_voting=True)
    assert abs(boxes.yaw[0]) == pytest.approx(math.pi, abs=1e-5)


@pytest.mark.parametrize("value", [-1e4, 1e4])
def test_extreme_output_still_gives_valid_boxes(value: float) -> None:
    output = said((CELL, CAR, 0.9, 0.5))
    output.residuals[0, CELL, 3:] = value
    output.log_variance[0, CELL] = value
    boxes, variance = decoded(output)
    assert len(boxes) == 1
    assert np.isfinite(variance).all()
