"""Where2comm sends the cells where an agent is confident, and the ego listens to those and no others."""

from __future__ import annotations

import itertools
import math

import numpy as np
import pytest
import torch

from cobevglue.fusion import fusion_class
from cobevglue.fusion.where2comm import ConfidenceAttention, Where2comm, _sinusoids, smoothed
from cobevglue.messages import encode_arrays
from cobevglue.perception import PerceptionOutput
from cobevglue.se2 import SE2

from . import checks

DETECTOR = checks.small_detector()
ROWS, COLUMNS = 16, 32
CHANNELS = 8


def method_with(threshold: float) -> Where2comm:
    method = checks.seeded(Where2comm, DETECTOR)
    method.threshold = threshold
    return method


def threshold_for(seen: PerceptionOutput, count: int) -> float:
    """The threshold at which so many cells are selected: halfway between the last of them and the next."""
    with torch.inference_mode():
        _, confidence, _ = method_with(0.0).share([m[None] for m in seen.features])
        ordered = smoothed(confidence).flatten().sort(descending=True).values.double()
    return float(ordered[count - 1] + ordered[count]) / 2 if count < len(ordered) else 0.0


def test_bytes_are_those_of_the_selected_cells() -> None:
    seen = checks.view(DETECTOR, 0)
    empty = len(encode_arrays(method_with(1.0).message(seen)))
    for count in (5, 50, 250, ROWS * COLUMNS):
        message = method_with(threshold_for(seen, count)).message(seen)
        assert len(message["cells"]) == count
        assert message["cells"].dtype == np.uint16
        assert message["features"].dtype == np.float16
        assert len(encode_arrays(message)) == empty + count * 2 * (1 + CHANNELS)


def test_threshold_0_sends_everything_and_1_nothing() -> None:
    seen = checks.view(DETECTOR, 0)
    message = method_with(0.0).message(seen)
    np.testing.assert_array_equal(message["cells"], np.arange(ROWS * COLUMNS))
    assert message["features"].shape == (ROWS * COLUMNS, CHANNELS)
    assert len(method_with(1.0).message(seen)["cells"]) == 0


def test_received_map_is_the_masked_map() -> None:
    seen = checks.view(DETECTOR, 0)
    method = method_with(threshold_for(seen, 150))
    with torch.inference_mode():
        shared, confidence, selected = method.share([m[None] for m in seen.features])
        arrived = method.received_maps(method.message(seen))
    assert selected.sum() == 150
    torch.testing.assert_close(arrived[2], selected[0], atol=0.0, rtol=0.0)
    torch.testing.assert_close(arrived[0], (shared * selected)[0], atol=1e-3, rtol=1e-3)
    torch.testing.assert_close(arrived[1], (confidence * selected)[0], atol=2e-3, rtol=1e-3)


def test_confident_cells_are_those_that_are_sent() -> None:
    seen = checks.view(DETECTOR, 0)
    method = method_with(0.0)
    with torch.inference_mode():
        shared, confidence, _ = method.share([m[None] for m in seen.features])
        scores = method.head(shared).logits.sigmoid().view(ROWS, COLUMNS, -1).amax(dim=-1)
    torch.testing.assert_close(confidence[0, 0], scores)
    smooth = np.zeros((ROWS, COLUMNS))
    line = np.exp(-0.5 * np.arange(-2, 3) ** 2)
    kernel = np.outer(line, line) / line.sum() ** 2
    padded = np.pad(scores.numpy(), 2)
    for row in range(ROWS):
        for column in range(COLUMNS):
            smooth[row, column] = (kernel * padded[row : row + 5, column : column + 5]).sum()
    ordered = np.sort(smooth.ravel())
    gap = int(np.diff(ordered).argmax())  # so that rounding does not matter
    threshold = float(ordered[gap : gap + 2].mean())
    cells = method_with(threshold).message(seen)["cells"]
    np.testing.assert_array_equal(cells, np.flatnonzero(smooth.ravel() >= threshold))


def test_training_selects_random_share_of_confident_cells() -> None:
    seen = checks.view(DETECTOR, 0)
    method = method_with(0.5).train()
    with torch.random.fork_rng(devices=[]), torch.no_grad():
        torch.manual_seed(0)
        _, confidence, selected = method.share([m[None].expand(50, -1, -1, -1) for m in seen.features])
    counts = selected.sum(dim=(1, 2, 3))
    assert counts.min() >= 1
    assert counts.max() > 10 * counts.min()
    assert len(set(counts.tolist())) > 20
    order = counts.argsort()
    for fewer, more in itertools.pairwise(order):  # all of one map: the more there are, the more are in
        assert (selected[fewer] <= selected[more]).all()
    one = selected[order[0], 0] > 0
    assert confidence[0, 0][one].mean() > confidence[0, 0].mean()


def test_the_ego_is_never_masked() -> None:
    seen = checks.view(DETECTOR, 0)
    checks.assert_same_boxes(method_with(0.0).fuse(seen, []), method_with(1.0).fuse(seen, []), atol=0.0)
    method = method_with(0.0)
    with torch.no_grad():
        (there,) = method.train().fused([checks.sample_of([seen])])
        (again,) = method.fused([checks.sample_of([seen])])
    torch.testing.assert_close(there, again, atol=0.0, rtol=0.0)


@pytest.mark.parametrize("threshold", [0.0, 1.0])
def test_agent_sending_nothing_nearby_changes_nothing(threshold: float) -> None:
    ego, other = checks.view(DETECTOR, 0), checks.view(DETECTOR, 1)
    method = method_with(threshold)
    pose = checks.FAR if threshold == 0.0 else checks.POSES[0]
    checks.assert_same_boxes(method.fuse(ego, [checks.sent(method, other, pose)]), method.fuse(ego, []), atol=1e-6)


def test_message_equals_training_input() -> None:
    ego, other = checks.view(DETECTOR, 0), checks.view(DETECTOR, 1)
    method = method_with(threshold_for(other, 150))
    with torch.inference_mode():
        (seen,) = method.fused([checks.sample_of([ego, other])])
        received = method.received_maps(checks.sent(method, other, checks.POSES[0]).content)
        own = method.share([m[None] for m in ego.features])
        maps = [torch.cat([mine, theirs[None]]) for mine, theirs in zip(own, received, strict=True)]
        (over_the_wire,) = method._fuse(maps, [SE2(), checks.POSES[0]])
    torch.testing.assert_close(over_the_wire, seen[0], atol=2e-3, rtol=1e-3)


def test_attention_equals_the_formula() -> None:
    rng = np.random.default_rng(0)
    features, confidence = rng.normal(size=(3, 5, 1, 2)), rng.uniform(0.1, 0.9, (3, 1, 1, 2))
    distance = rng.uniform(0, 50, (3, 1, 1, 2))
    present = np.array([[True, True], [True, False], [True, True]]).reshape(3, 1, 1, 2)
    attention = ConfidenceAttention(5).double()
    inputs = [torch.from_numpy(v) for v in (features, confidence, present, distance)]
    with torch.no_grad():
        weight, fused = attention.weights(*inputs)[:, 0, 0].numpy(), attention(*inputs).numpy()[:, 0]
        told = np.concatenate([features, _sinusoids(inputs[3]).numpy()], axis=1)
    matrix = {n: p.detach().numpy() for n, p in attention.named_parameters()}
    for cell in range(2):
        x = told[:, :, 0, cell]
        query = matrix["query.weight"][:, :, 0, 0] @ x[0] + matrix["query.bias"]
        key = x @ matrix["key.weight"][:, :, 0, 0].T
        raw = np.exp(key @ query / math.sqrt(5)) * confidence[:, 0, 0, cell] * present[:, 0, 0, cell]
        np.testing.assert_allclose(weight[:, cell], raw / raw.sum(), atol=1e-12)
        mixed = (raw / raw.sum()) @ features[:, :, 0, cell]
        hidden = np.maximum(matrix["feed_forward.0.weight"][:, :, 0, 0] @ mixed + matrix["feed_forward.0.bias"], 0.0)
        added = matrix["feed_forward.2.weight"][:, :, 0, 0] @ hidden + matrix["feed_forward.2.bias"]
        np.testing.assert_allclose(fused[:, cell], mixed + added, atol=1e-12)


def test_distances_are_those_to_the_sensor() -> None:
    distance = method_with(0.0).distance[0, 0]
    assert distance.shape == (ROWS, COLUMNS)
    assert distance[0, 0].item() == pytest.approx(math.hypot(12.4, 6.0), abs=1e-5)
    assert distance[8, 16].item() == pytest.approx(math.hypot(0.4, 0.4), abs=1e-5)
    assert distance[8, 31].item() == pytest.approx(math.hypot(12.4, 0.4), abs=1e-5)


def test_cells_outside_the_map_are_refused() -> None:
    method = method_with(0.0)
    message = {"cells": np.array([ROWS * COLUMNS], np.uint16), "features": np.zeros((1, CHANNELS), np.float16)}
    with pytest.raises(ValueError, match="message"):
        method.received_maps(message)
    with pytest.raises(ValueError, match="message"):
        method.received_maps({**message, "cells": np.zeros(0, np.uint16)})


def test_it_is_found_by_its_name() -> None:
    assert fusion_class("where2comm") is Where2comm
