"""Integer columns round-trip, are what the format says, and damaged ones are refused in bounded memory."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bitymi_ns.codec.streams import StreamError, compress, decompress
from tests.codec.reference import decode_integers


def columns(random, rows: int, numbers: int, bits: int) -> np.ndarray:
    drawn = [
        [random.randrange(-(1 << random.randint(1, bits)), 1 << bits) for _ in range(numbers)] for _ in range(rows)
    ]
    return np.array(drawn, dtype=np.int64).reshape(rows, numbers)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 40), st.integers(0, 4), st.integers(1, 50), st.randoms(use_true_random=False))
def test_integers_come_back(rows: int, numbers: int, bits: int, random) -> None:
    codes = columns(random, rows, numbers, bits)
    found = compress(codes)
    assert len(found.data) == sum(found.sizes) and len(found.sizes) == numbers
    np.testing.assert_array_equal(decompress(memoryview(found.data), rows, found.sizes), codes)


@settings(max_examples=30, deadline=None)
@given(st.integers(1, 9), st.integers(1, 40), st.integers(1, 3), st.integers(1, 12), st.randoms(use_true_random=False))
def test_coefficients_of_blocks_come_back(coefficients: int, blocks: int, numbers: int, bits: int, random) -> None:
    codes = columns(random, coefficients * blocks, numbers, bits).reshape(coefficients, blocks, numbers)
    found = compress(codes)
    decoded = decompress(memoryview(found.data), coefficients * blocks, found.sizes, blocks)
    np.testing.assert_array_equal(decoded, codes.reshape(-1, numbers))


@pytest.mark.parametrize("blocks", [0, 100])
@pytest.mark.parametrize("scale", [0.3, 3.0, 1e3, 1e12])
def test_the_reference_reads_what_is_written(scale: float, blocks: int) -> None:
    rng = np.random.default_rng(0)
    walk = np.cumsum(rng.laplace(scale=0.3 * scale, size=(1600, 1)), axis=0)
    codes = np.rint(walk + rng.laplace(scale=scale, size=(1600, 3))).astype(np.int64)
    found = compress(codes.reshape(-1, blocks, 3) if blocks else codes)
    at, others = 0, np.zeros(1600, dtype=np.int64)
    for k, size in enumerate(found.sizes):
        number = decode_integers(found.data[at : at + size], 1600, blocks, others if blocks and k else None)
        np.testing.assert_array_equal(number, codes[:, k])
        others = np.minimum(2, others + np.abs(codes[:, k]))
        at += size


def test_few_bytes_are_spent() -> None:
    rng = np.random.default_rng(1)
    flat = np.full((50_000, 1), -7)
    assert len(compress(flat).data) < 20
    codes = np.rint(rng.normal(0, 20, (50_000, 1))).astype(np.int64)
    _, counts = np.unique(codes, return_counts=True)
    entropy = -(counts * np.log2(counts / counts.sum())).sum() / 8
    assert len(compress(codes).data) < 1.01 * entropy
    # magnitudes that fall along the coefficients of a block, and differ from block to block
    size = np.exp(rng.normal(0, 1, (1, 4000, 1))) * 0.8 ** np.arange(16)[:, None, None]
    blocks = np.rint(rng.laplace(scale=size, size=(16, 4000, 1))).astype(np.int64)
    assert len(compress(blocks).data) < 0.93 * len(compress(blocks.reshape(-1, 1)).data)


def test_damage_is_refused() -> None:
    import bitymi_ns._cpu  # noqa: F401 - in a wheel beside the module in use, and its exception is not that one's

    rng = np.random.default_rng(2)
    codes = np.rint(rng.laplace(scale=30, size=(500, 1))).astype(np.int64)
    whole = compress(codes).data
    for data in (whole[:-1], whole + b"\0", b"", b"\xff" * 40, whole[:20]):
        with pytest.raises(StreamError, match="a column is damaged"):
            decompress(memoryview(data), 500, [len(data)])
    with pytest.raises(StreamError, match=f"have 3 bytes, not {len(whole)}"):
        decompress(memoryview(whole), 500, [3])
    opened = 0
    for _ in range(3000):
        data = bytearray(whole)
        data[rng.integers(len(data))] ^= 1 << rng.integers(8)
        try:
            opened += len(decompress(memoryview(bytes(data)), 500, [len(data)])) == 500
        except StreamError:
            continue
    assert opened < 1000  # flips of plain bits are other numbers; most others change the coder's last state


def test_tables_take_bounded_memory() -> None:
    tracemalloc.start()
    with pytest.raises(StreamError):
        decompress(memoryview(b"\0\2\0" + b"\xff" * 1000), 10, [1003])
    assert tracemalloc.get_traced_memory()[1] < 1 << 20
    tracemalloc.stop()
