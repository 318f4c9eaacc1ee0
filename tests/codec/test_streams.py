"""Columns of integers: they come back, and a frame takes no more memory than it is asked for."""

import numpy as np
import pytest
import zstandard
from hypothesis import given, settings
from hypothesis import strategies as st

from bitymi_ns.codec.streams import StreamError, compress, decompress, plane_bytes


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 40), st.integers(0, 4), st.integers(1, 50), st.randoms(use_true_random=False))
def test_integers_come_back(rows: int, numbers: int, bits: int, random) -> None:
    drawn = [[random.randrange(-(1 << bits), 1 << bits) for _ in range(numbers)] for _ in range(rows)]
    codes = np.array(drawn, dtype=np.int64).reshape(rows, numbers)
    found = compress(codes)
    assert len(found.data) == sum(map(sum, found.planes))
    np.testing.assert_array_equal(decompress(memoryview(found.data), rows, found.low, found.planes), codes)


def test_equal_integers_take_no_bytes() -> None:
    found = compress(np.full((100, 2), -7))
    assert found.data == b"" and found.planes == [[], []] and found.low == [-7, -7]


@pytest.mark.parametrize("size", [999, 1001, 0])
def test_a_frame_of_another_size_is_refused(size: int) -> None:
    frame = zstandard.compress(bytes(1000))
    with pytest.raises(StreamError, match=f"declares 1000 bytes, {size} are wanted"):
        plane_bytes(memoryview(frame), size)


def test_a_frame_that_hides_its_size_or_is_followed_by_more_is_refused() -> None:
    hidden = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(1000))
    with pytest.raises(StreamError):
        plane_bytes(memoryview(hidden), 1000)
    with pytest.raises(StreamError):
        plane_bytes(memoryview(zstandard.compress(bytes(1000)) + b"\0"), 1000)
    with pytest.raises(StreamError):
        plane_bytes(memoryview(b"no frame"), 8)
