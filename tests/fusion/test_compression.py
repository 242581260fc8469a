"""Compressed features: how far they are off, which cells travel, and what they weigh."""

from __future__ import annotations

import zlib

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from cobevglue.fusion import FUSION_METHODS, CompressedFusion, Compression, IntermediateFusion, Received
from cobevglue.fusion.compression import compress, decompress, most_confident
from cobevglue.fusion.where2comm import smoothed
from cobevglue.messages import Arrays, MessageError, decode_arrays, encode_arrays

from . import checks
from .test_every_method import made

DETECTOR = checks.small_detector()
ROWS, COLUMNS = 16, 32
LEARNED = [name for name, kind in FUSION_METHODS.items() if issubclass(kind, IntermediateFusion)]
WITH_MAPS = [name for name in LEARNED if made(name).shares_maps]
MAPS = npst.arrays(
    np.float16,
    st.tuples(st.integers(1, 4), st.integers(1, 6), st.integers(1, 6)),
    elements=st.floats(-60000, 60000, width=16),
)


def through(content: Arrays) -> Arrays:
    """What arrives of a message that went over the wire."""
    return decompress(decode_arrays(encode_arrays(content)))


@given(MAPS, st.integers(2, 8))
def test_error_is_at_most_half_a_step(values: np.ndarray, bits: int) -> None:
    back = through(compress({"map0": values}, bits))["map0"]
    exact = values.astype(np.float64)
    spread = exact.max(axis=(1, 2), keepdims=True) - exact.min(axis=(1, 2), keepdims=True)
    rounding = 1e-6 * np.abs(exact).max()
    assert back.shape == values.shape
    assert (np.abs(back - exact) <= 0.5 * spread / (2**bits - 1) + rounding).all()


@given(st.integers(2, 8), st.data())
def test_values_on_the_grid_arrive_exactly(bits: int, data: st.DataObject) -> None:
    top = 2**bits - 1
    codes = data.draw(npst.arrays(np.uint8, (3, 4, 5), elements=st.integers(0, top)))
    codes[:, 0, :2] = 0, top  # every channel has its minimum and its maximum
    low, step = np.float32(-0.75), np.float32(0.125)
    values = (low + step * codes).astype(np.float16)
    np.testing.assert_array_equal(through(compress({"map0": values}, bits))["map0"], values.astype(np.float32))


def test_zero_stays_zero_in_maps_of_a_relu() -> None:
    values = np.maximum(np.random.default_rng(0).normal(size=(8, 10, 12)), 0.0).astype(np.float16)
    back = through(compress({"map0": values}, 3))["map0"]
    assert (values == 0).mean() > 0.4
    assert (back[values == 0] == 0.0).all()


def test_other_types_than_float16_arrive_as_sent() -> None:
    content: Arrays = {
        "proposals": np.array([[1e4 + 0.125]], np.float32),
        "cells": np.arange(3, dtype=np.uint16),
        "features": np.zeros((0, 4), np.float16),
    }
    back = through(compress(content, 4))
    assert list(back) == list(content)
    for name in ("proposals", "cells"):
        assert back[name].dtype == content[name].dtype
        np.testing.assert_array_equal(back[name], content[name])
    assert back["features"].shape == (0, 4)


@settings(deadline=None, max_examples=30)
@given(st.integers(0, 2**32 - 1), st.floats(0.01, 1.0))
def test_only_most_confident_cells_are_transmitted(seed: int, share: float) -> None:
    rng = np.random.default_rng(seed)
    confidence = torch.from_numpy(rng.random((1, 1, ROWS, COLUMNS)).astype(np.float32))
    cells = most_confident(confidence, share)
    smooth = smoothed(confidence)[0, 0].numpy()
    assert cells.sum() == max(1, round(share * ROWS * COLUMNS))
    if not cells.all():
        assert smooth[cells].min() >= smooth[~cells].max()
    fine = rng.uniform(1, 2, (2, ROWS, COLUMNS)).astype(np.float16)
    coarse = rng.uniform(1, 2, (3, ROWS // 4, COLUMNS // 4)).astype(np.float16)
    back = through(compress({"map0": fine, "map1": coarse}, 8, cells))
    np.testing.assert_array_equal(back["sent"], cells)
    np.testing.assert_array_equal(back["map0"] > 0, np.broadcast_to(cells, fine.shape))
    touched = cells.reshape(ROWS // 4, 4, COLUMNS // 4, 4).any(axis=(1, 3))
    np.testing.assert_array_equal(back["map1"] > 0, np.broadcast_to(touched, coarse.shape))


@pytest.mark.parametrize("name", LEARNED)
def test_fine_quantisation_hardly_changes_the_result(name: str) -> None:
    method = made(name)
    compressed = CompressedFusion(method, Compression(bits=8))
    ego, other = checks.view(DETECTOR, 0), checks.view(DETECTOR, 1)
    content = decode_arrays(encode_arrays(compressed.message(other)))
    got = compressed.fuse(ego, [Received(content, checks.POSES[0])])
    wanted = method.fuse(ego, [checks.sent(method, other, checks.POSES[0])])
    assert got.score is not None
    assert wanted.score is not None
    np.testing.assert_allclose(got.score[:3], wanted.score[:3], atol=0.1)


@pytest.mark.parametrize("name", WITH_MAPS)
def test_fewer_cells_and_bits_cost_fewer_bytes(name: str) -> None:
    method, seen = made(name), checks.view(DETECTOR, 1)

    def size(**options: float) -> int:
        return len(encode_arrays(CompressedFusion(method, Compression.model_validate(options)).message(seen)))

    assert size(bits=8) < 0.6 * len(encode_arrays(method.message(seen)))
    assert size(bits=2, cells=0.1) < size(bits=8, cells=0.1) < size(bits=8, cells=0.5) < size(bits=8)


@pytest.mark.parametrize("name", WITH_MAPS)
def test_unsent_cells_count_as_out_of_reach(name: str) -> None:
    method = made(name)
    ego, other = checks.view(DETECTOR, 0), checks.view(DETECTOR, 1)
    received = checks.sent(method, other, checks.POSES[0])
    maps = {name: np.zeros_like(values) for name, values in received.content.items()}
    nothing = Received({**maps, "sent": np.zeros((ROWS, COLUMNS), bool)}, checks.POSES[0])
    whole = Received({**received.content, "sent": np.ones((ROWS, COLUMNS), bool)}, checks.POSES[0])
    checks.assert_same_boxes(method.fuse(ego, [whole]), method.fuse(ego, [received]))
    if name not in ("coalign", "cobevglue"):  # whose attention counts empty cells; which sends boxes, too
        checks.assert_same_boxes(method.fuse(ego, [nothing]), method.fuse(ego, []))


@pytest.mark.parametrize(
    ("name", "options", "message"),
    [
        ("late", {}, "LateFusion sends boxes, only features can be compressed"),
        ("where2comm", {"cells": 0.5}, "cells: Where2comm sends no whole maps"),
        ("fpv-rcnn", {"cells": 0.5}, "cells: FPVRCNN sends no whole maps"),
    ],
)
def test_invalid_compression_is_refused(name: str, options: dict[str, float], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CompressedFusion(FUSION_METHODS[name](DETECTOR), Compression.model_validate(options))


@pytest.mark.parametrize("options", [{"bits": 1}, {"bits": 9}, {"cells": 0.0}, {"cells": 1.1}, {"bit": 8}])
def test_settings_out_of_range_are_refused(options: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=next(iter(options))):
        Compression.model_validate(options)


def coded(data: bytes) -> Arrays:
    """As a sender's mistake, or malice, might have it."""
    return {"coded": np.frombuffer(data, np.uint8)}


U1, U2, F4 = np.uint8, np.uint16, np.float32
ONE_CELL: dict[str, np.ndarray] = {"sent": np.full(1, 128, U1), "sent/shape": np.ones(2, U2)}
HUGE: dict[str, np.ndarray] = {
    "map0": np.zeros((60000, 1), U1),
    "map0/range": np.zeros((2, 60000, 1), F4),
    "map0/shape": np.full(2, 60000, U2),
}


@pytest.mark.parametrize(
    "content",
    [
        {},
        {"map0": np.zeros(3, np.float16)},
        coded(b"not zlib"),
        coded(zlib.compress(encode_arrays({"a": np.zeros(9)}))[:-8]),
        coded(zlib.compress(b"no arrays")),
        coded(zlib.compress(encode_arrays({"sent": np.zeros(1, U1)}))),
        coded(zlib.compress(encode_arrays({"sent": np.zeros(1, U1), "sent/shape": np.full(2, 60000, U2)}))),
        coded(zlib.compress(encode_arrays({**ONE_CELL, **HUGE}))),
        coded(zlib.compress(encode_arrays({"a": np.zeros(3, U1), "a/range": np.zeros(5, F4)}))),
    ],
    ids=["nothing", "raw", "not zlib", "cut short", "no arrays", "no shape", "few cells", "huge map", "wrong range"],
)
def test_damaged_messages_are_refused(content: Arrays) -> None:
    with pytest.raises(MessageError, match="compressed message"):
        decompress(content)
