"""Arrays arrive as they were sent, or not at all."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra import numpy as npst

from cobevglue.messages import MessageError, decode_arrays, encode_arrays

ARRAYS = st.dictionaries(
    st.text(min_size=1, max_size=20),
    st.sampled_from(["<f2", "<f4", "<f8", "u1", "<u2", "<u4", "i1", "<i2", "<i4", "<i8"]).flatmap(
        lambda dtype: npst.arrays(dtype, npst.array_shapes(min_dims=0, max_dims=4, min_side=0, max_side=5))
    ),
    max_size=4,
)


@given(ARRAYS)
def test_arrays_round_trip(arrays: dict[str, np.ndarray]) -> None:
    received = decode_arrays(encode_arrays(arrays))
    assert list(received) == list(arrays)
    for name, array in arrays.items():
        assert received[name].dtype == array.dtype
        assert received[name].shape == array.shape
        assert received[name].tobytes() == array.tobytes()  # NaN is not equal to itself


@given(ARRAYS, st.data())
def test_no_flipped_bit_goes_unnoticed(arrays: dict[str, np.ndarray], data: st.DataObject) -> None:
    message = bytearray(encode_arrays(arrays))
    place = data.draw(st.integers(0, len(message) - 1))
    message[place] ^= 1 << data.draw(st.integers(0, 7))
    with pytest.raises(MessageError):
        decode_arrays(bytes(message))


@given(ARRAYS, st.integers(0, 50))
def test_a_message_cut_short_is_refused(arrays: dict[str, np.ndarray], length: int) -> None:
    message = encode_arrays(arrays)
    with pytest.raises(MessageError):
        decode_arrays(message[: min(length, len(message) - 1)])


def test_size_is_data_plus_small_header() -> None:
    message = encode_arrays({"map0": np.zeros((48, 100, 176), dtype=np.float16)})
    assert len(message) == 48 * 100 * 176 * 2 + (6 + 1 + 4 + 2 + 3 * 4 + 4)


def test_big_endian_arrays_are_sent_little_endian() -> None:
    received = decode_arrays(encode_arrays({"a": np.array([1.5, 2.5], dtype=">f4")}))
    np.testing.assert_array_equal(received["a"], [1.5, 2.5])


@pytest.mark.parametrize(
    ("arrays", "what"),
    [
        ({"a": np.zeros(2, dtype=np.complex64)}, "complex64"),
        ({"a": np.array(["x"])}, "<U1"),
        ({"": np.zeros(2)}, "''"),
        ({"x" * 256: np.zeros(2)}, "cannot be encoded"),
        ({str(i): np.zeros(1) for i in range(256)}, "256 arrays"),
    ],
)
def test_unsupported_arrays_are_named(arrays: dict[str, np.ndarray], what: str) -> None:
    with pytest.raises(MessageError, match=what):
        encode_arrays(arrays)


def test_received_arrays_cannot_be_changed() -> None:
    received = decode_arrays(encode_arrays({"a": np.zeros(3)}))
    with pytest.raises(ValueError, match="read-only"):
        received["a"][0] = 1.0
