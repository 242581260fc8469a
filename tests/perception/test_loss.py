"""The loss is small where the output is right, finite where there is nothing, and blames the right part."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from cobevglue.perception import (
    AnchorGrid,
    DetectionLoss,
    HeadOutput,
    LossTerms,
    TargetBatch,
    assign_targets,
    collate_targets,
)

from .conftest import OBJECTS, SMALL

GRID = AnchorGrid(SMALL)
N = len(GRID)
LOSS = DetectionLoss(SMALL)


def targets(*clouds: tuple[np.ndarray, bool]) -> TargetBatch:
    return collate_targets([assign_targets(b, np.full(len(b), ignore), GRID) for b, ignore in clouds], N)


def perfect(batch: TargetBatch, clouds: int) -> HeadOutput:
    """Sure of everything, and right; with a standard deviation of 10 cm and 0.1 rad."""
    logits = torch.full((clouds * N,), -12.0)
    logits[batch.positive] = 12.0
    residuals, direction = torch.zeros(clouds * N, 7), torch.zeros(clouds * N, 2)
    residuals[batch.positive] = batch.residuals
    direction[batch.positive, batch.direction] = 12.0
    log_variance = torch.full((clouds, N, 3), math.log(0.01))
    parts = (logits.view(clouds, N), residuals.view(clouds, N, 7), direction.view(clouds, N, 2), log_variance)
    return HeadOutput(*(p.requires_grad_() for p in parts))


def check_gradients(output: HeadOutput, terms: LossTerms) -> None:
    terms.total.backward()  # type: ignore[no-untyped-call]
    assert all(torch.isfinite(t) for t in terms)
    assert all(v.grad is not None and torch.isfinite(v.grad).all() for v in output)


def test_perfect_output_costs_nothing() -> None:
    batch = targets((OBJECTS, False), (OBJECTS[:1], False))
    terms = LOSS(perfect(batch, 2), batch)
    assert terms.classification < 1e-4
    assert terms.box < 1e-6
    assert terms.direction < 1e-3


def test_batch_targets_are_found_in_their_cloud() -> None:
    batch = targets((OBJECTS[:0], False), (OBJECTS, False))
    assert (batch.positive >= N).all()
    assert LOSS(perfect(batch, 2), batch).total < LOSS(perfect(targets((OBJECTS, False)), 2), batch).total


@pytest.mark.parametrize("objects", [OBJECTS[:0], OBJECTS])
def test_frames_without_anything_to_find_are_finite(objects: np.ndarray) -> None:
    batch = targets((objects, True))
    output = perfect(batch, 1)
    terms = LOSS(output, batch)
    check_gradients(output, terms)
    assert terms.box == terms.direction == terms.uncertainty == 0


def test_reversed_box_costs_direction_only() -> None:
    batch = targets((OBJECTS, False))
    output = perfect(batch, 1)
    right = LOSS(output, batch)
    turned = output._replace(residuals=output.residuals + torch.tensor([0, 0, 0, 0, 0, 0, math.pi]))
    wrong = LOSS(turned, batch)
    assert wrong.box.item() == pytest.approx(right.box.item(), abs=1e-5)
    assert wrong.uncertainty.item() == pytest.approx(right.uncertainty.item(), abs=1e-3)
    assert LOSS(output._replace(direction=-output.direction), batch).direction > 5


def test_ignored_anchors_cost_nothing() -> None:
    batch = targets((OBJECTS, True))
    output = perfect(batch, 1)
    logits = output.logits.detach().clone()
    logits[0, batch.ignored] = 8.0
    assert LOSS(output._replace(logits=logits), batch).classification == LOSS(output, batch).classification


def test_a_false_alarm_costs() -> None:
    batch = targets((OBJECTS[:1], False))
    output = perfect(batch, 1)
    logits = output.logits.detach().clone()
    logits[0, 0] = 8.0
    assert LOSS(output._replace(logits=logits), batch).classification > 0.5


@pytest.mark.parametrize("column", [0, 1, 2])
def test_best_variance_is_squared_error(column: int) -> None:
    """And learning it moves no box: the residuals' gradient is that of the box loss alone."""
    batch = targets((OBJECTS[:1], False))
    output = perfect(batch, 1)
    diagonal = torch.tensor(GRID.diagonal, dtype=torch.float32).repeat(GRID.rows * GRID.columns)
    residuals = output.residuals.detach().clone()
    error = 0.2
    residuals[0, :, (0, 1, 6)[column]] += error if column == 2 else error / diagonal
    costs = {}
    for deviation in (0.1, 0.2, 0.4):
        log_variance = torch.full((1, N, 3), math.log(0.01))
        log_variance[..., column] = 2 * math.log(deviation)
        costs[deviation] = LOSS(output._replace(residuals=residuals, log_variance=log_variance), batch).uncertainty
    assert costs[0.2] < min(costs[0.1], costs[0.4])

    moved = residuals.requires_grad_()
    LOSS(output._replace(residuals=moved), batch).uncertainty.backward()  # type: ignore[no-untyped-call]
    assert moved.grad is None or not moved.grad.any()


@pytest.mark.parametrize("value", [-1000.0, 1000.0])
def test_extreme_output_is_finite(value: float) -> None:
    batch = targets((OBJECTS, False))
    output = HeadOutput(*(torch.full_like(v, value).requires_grad_() for v in perfect(batch, 1)))
    check_gradients(output, LOSS(output, batch))
