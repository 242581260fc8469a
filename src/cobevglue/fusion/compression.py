"""Compression of transmitted features: fewer bits a number, fewer cells of the maps, and run-length coding.

Works on the messages of all methods that share features. Features are the arrays of type float16 in a message; boxes
and keypoints, in float32, keep their precision. In this order, the sender

1. selects cells (Where2comm, Hu et al., NeurIPS 2022): those in which its own decoder is most confident of an object;
2. quantises each channel uniformly between its minimum and its maximum in this frame, which are sent with it;
3. encodes the arrays as any message, and codes these bytes with zlib (runs of equal bytes, and Huffman's code).

Measured against principal components of the channels (a 1 x 1 convolution at the sender and its transpose at the
receiver), fewer bits have the better average precision at equal bytes: `docs/collaboration.md`.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Sequence
from dataclasses import replace
from typing import Annotated

import numpy as np
import torch
from numpy.typing import NDArray
from pydantic import Field
from torch import Tensor

from cobevglue.boxes import Boxes
from cobevglue.fusion.intermediate import IntermediateFusion, pooled
from cobevglue.fusion.method import FusionMethod, Received
from cobevglue.fusion.where2comm import smoothed
from cobevglue.messages import Arrays, MessageError, decode_arrays, encode_arrays
from cobevglue.perception import PerceptionOutput
from cobevglue.settings import Settings
from cobevglue.typing import BoolArray, Float32Array

__all__ = ["CompressedFusion", "Compression", "compress", "decompress", "most_confident"]

_CODED, _SENT, _RANGE, _SHAPE = "coded", "sent", "/range", "/shape"
"""Names of arrays: the whole message; selected cells; minimum and step of the array before "/"; shape of a map."""
_MOST_BYTES = 1 << 28
"""Of a decoded message: one that claims more is refused."""


class Compression(Settings):
    """How features are compressed.

    Attributes:
        bits: of a number, 2 to 8.
        cells: share of the cells of the maps that are sent, more than 0 and at most 1; 1 sends all. Less than 1 is for
            methods that share maps (`IntermediateFusion.shares_maps`) only.

    Raises:
        ValueError: a value out of its range.
    """

    bits: Annotated[int, Field(ge=2, le=8)] = 8
    cells: Annotated[float, Field(gt=0.0, le=1.0)] = 1.0


class CompressedFusion(FusionMethod):
    """A fusion method whose features are compressed. The ego's own features are not.

    Args:
        method: one that shares features.
        compression: of its messages.

    Raises:
        ValueError: the method shares no features; or cells are to be selected, and it shares no maps.
    """

    def __init__(self, method: FusionMethod, compression: Compression) -> None:
        name = type(method).__name__
        if not isinstance(method, IntermediateFusion):
            raise ValueError(f"compression: {name} sends {method.kind}, only features can be compressed")
        if compression.cells < 1.0 and not method.shares_maps:
            raise ValueError(f"compression: cells: {name} sends no whole maps of which cells could be selected")
        self.method, self.compression = method, compression
        self.usual_aligner = method.usual_aligner  # type: ignore[misc]  # of this method

    def message(self, observation: PerceptionOutput) -> Arrays:
        """The method's message, compressed."""
        cells = None
        if self.compression.cells < 1.0:
            cells = most_confident(self.method.confidence(observation), self.compression.cells)
        return compress(self.method.message(observation), self.compression.bits, cells)

    def fuse(self, ego: PerceptionOutput, received: Sequence[Received]) -> Boxes:
        """The method's boxes from the decompressed messages."""
        return self.method.fuse(ego, [replace(other, content=decompress(other.content)) for other in received])


def most_confident(confidence: Tensor, share: float) -> BoolArray:
    """(H, W) whether a cell is among this share of all, at least one, in which objects are most likely.

    As in Where2comm, the confidence is smoothed by a Gaussian first, which keeps some context around an object.

    Args:
        confidence: (1, 1, H, W) of an object in each cell.
        share: of the cells that are selected.
    """
    smooth = smoothed(confidence)[0, 0]
    count = max(1, round(share * smooth.numel()))
    selected = torch.zeros_like(smooth, dtype=torch.bool).flatten()
    selected[smooth.flatten().argsort(descending=True, stable=True)[:count]] = True
    mask: BoolArray = selected.view_as(smooth).cpu().numpy()
    return mask


def compress(content: Arrays, bits: int, cells: BoolArray | None = None) -> Arrays:
    """A message with its float16 arrays quantised, run-length coded.

    Args:
        content: the message.
        bits: of a number.
        cells: (H, W) cells of the finest map that are sent; of a coarser map those with any of these in them are. None
            for all.
    """
    parts: dict[str, NDArray[np.generic]] = {}
    if cells is not None:
        parts |= {_SENT: np.packbits(cells), _SENT + _SHAPE: np.array(cells.shape, np.uint16)}
    for name, array in content.items():
        if array.dtype != np.float16:
            parts[name] = array
            continue
        values = array.astype(np.float32)
        if cells is not None and name.startswith("map"):
            parts[name + _SHAPE] = np.array(array.shape[1:], np.uint16)
            values = values[:, _at_scale(cells, array.shape[1:])]
        parts[name + _RANGE], parts[name] = _quantised(values, bits, 0 if name.startswith("map") else -1)
    coder = zlib.compressobj(1, zlib.DEFLATED, zlib.MAX_WBITS, 9, zlib.Z_RLE)
    return {_CODED: np.frombuffer(coder.compress(encode_arrays(parts)) + coder.flush(), np.uint8)}


def decompress(content: Arrays) -> Arrays:
    """The message that `compress` was given, with quantised features in float32 and "sent", (H, W) the selected cells.

    Features of cells that were not sent are 0.

    Raises:
        MessageError: these are not the arrays of `compress`.
    """
    if set(content) != {_CODED}:
        raise MessageError(f"not a compressed message: it has {', '.join(content) or 'nothing'}")
    decoder = zlib.decompressobj()
    try:
        data = decoder.decompress(content[_CODED].tobytes(), _MOST_BYTES)
        if not decoder.eof:
            raise ValueError(f"cut short, or more than {_MOST_BYTES:,} bytes")
        return _restored(decode_arrays(data))
    except (zlib.error, KeyError, IndexError, TypeError, ValueError) as error:
        raise MessageError(f"compressed message: {error}") from None


def _restored(parts: Arrays) -> Arrays:
    content: dict[str, NDArray[np.generic]] = {}
    cells = None
    if _SENT in parts:
        rows, columns = parts[_SENT + _SHAPE].tolist()
        if len(parts[_SENT]) != -(-rows * columns // 8):
            raise ValueError(f"{len(parts[_SENT])} bytes for the {rows} x {columns} cells")
        cells = np.unpackbits(parts[_SENT], count=rows * columns).reshape(rows, columns).astype(bool)
        content[_SENT] = cells
    for name, array in parts.items():
        if name == _SENT or name.endswith((_RANGE, _SHAPE)):
            continue
        if name + _RANGE not in parts:
            content[name] = array
            continue
        low, step = parts[name + _RANGE]
        values = low + step * array.astype(np.float32)
        if cells is not None and name + _SHAPE in parts:
            shape = tuple(parts[name + _SHAPE].tolist())
            if 4 * len(values) * math.prod(shape) > _MOST_BYTES:
                raise ValueError(f"{name}: {len(values)} channels of {shape} cells are more than {_MOST_BYTES:,} bytes")
            whole = np.zeros((len(values), *shape), np.float32)
            whole[:, _at_scale(cells, shape)] = values
            values = whole
        content[name] = values
    return content


def _quantised(values: Float32Array, bits: int, channels: int) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Minimum and step of every channel, stacked, and codes: a value is its channel's minimum + its step x its code.

    Args:
        values: any shape.
        bits: of a code.
        channels: the axis of the channels, 0 or -1.
    """
    others = tuple(axis for axis in range(values.ndim) if axis != channels % values.ndim)
    low = values.min(axis=others, keepdims=True, initial=np.inf)
    high = values.max(axis=others, keepdims=True, initial=-np.inf)
    low, high = np.where(low <= high, low, 0.0), np.where(low <= high, high, 0.0)  # of an empty array
    step = ((high - low) / (2**bits - 1)).astype(np.float32)
    codes = np.rint((values - low) / np.where(step > 0.0, step, 1.0)).clip(0, 2**bits - 1).astype(np.uint8)
    return np.stack([low.astype(np.float32), step]), codes


def _at_scale(cells: BoolArray, shape: tuple[int, ...]) -> BoolArray:
    """(H, W) the selected cells of a map of this shape."""
    coarse: BoolArray = pooled(torch.from_numpy(cells)[None].float(), shape)[0].numpy() > 0.0
    return coarse
