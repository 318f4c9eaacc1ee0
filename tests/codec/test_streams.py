"""Integer columns round-trip, and decoding is bounded in memory."""

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


def test_frames_of_another_size_or_form_are_refused() -> None:
    frame = zstandard.compress(bytes(1000))
    for size in (999, 1001, 0):
        with pytest.raises(StreamError, match=f"declares 1000 bytes, {size} are wanted"):
            plane_bytes(memoryview(frame), size)
    hidden = zstandard.ZstdCompressor(write_content_size=False).compress(bytes(1000))
    for data in (hidden, frame + b"\0", b"no frame"):
        with pytest.raises(StreamError):
            plane_bytes(memoryview(data), 1000)
    found = compress(np.full((100, 2), -7))  # equal integers take no bytes
    assert found.data == b"" and found.planes == [[], []] and found.low == [-7, -7]
