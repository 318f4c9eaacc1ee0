"""Integer columns as bytes, entropy-coded."""

import math
from collections.abc import Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from bitymi_ns.ops.backend import load

Others = npt.NDArray[np.uint8] | None  # [rows] sums of the magnitudes of a row's earlier numbers
_OTHERS = 2  # largest context from a row's earlier numbers


class StreamError(ValueError):
    """Bytes that do not match their description."""


@dataclass(frozen=True)
class Compressed:
    sizes: list[int]  # bytes of each number
    data: bytes


def compress(codes: npt.NDArray[np.integer]) -> Compressed:
    """Compress int64 [rows, n], or coefficients of blocks [coefficients, blocks, n], of magnitude below 2^51."""
    blocks = codes.shape[1] if codes.ndim == 3 else 0
    rows = math.prod(codes.shape[:-1])
    numbers = np.ascontiguousarray(codes.reshape(rows, codes.shape[-1]).T, dtype=np.int64)
    others: list[Others] = [None]
    for number in numbers[:-1]:
        others.append(_others(others[-1], number, blocks))
    module = load("_cpu")
    with ThreadPoolExecutor(module.num_threads()) as pool:
        parts = list(pool.map(lambda number, of: module.encode_integers(number, blocks, of), numbers, others))
    return Compressed([len(part) for part in parts], b"".join(parts))


def bytes_of(columns: Iterable[npt.NDArray[np.integer]]) -> int:
    """Count the bytes of compressed columns."""
    return sum(len(compress(column).data) for column in columns)


def decompress(view: memoryview, rows: int, sizes: Sequence[int], blocks: int = 0) -> npt.NDArray[np.int64]:
    """Decompress what `compress` returned to int64 [rows, n], rows = coefficients * blocks with `blocks`. Raises
    StreamError: the bytes are damaged or do not match `rows` and `sizes`."""
    if sum(sizes) != len(view):
        raise StreamError(f"the numbers have {sum(sizes)} bytes, not {len(view)}")
    numbers, at, module = np.empty((len(sizes), rows), dtype=np.int64), 0, load("_cpu")
    others: Others = None
    for number, size in zip(numbers, sizes, strict=True):
        try:
            module.decode_integers(bytes(view[at : at + size]), number, blocks, others)
        except module.DamagedStream as error:
            raise StreamError(f"a column is damaged ({error})") from error
        others = _others(others, number, blocks)
        at += size
    return numbers.T


def _others(before: Others, number: npt.NDArray[np.int64], blocks: int) -> Others:
    """Add a number's magnitudes to the sums of those before it, clipped at `_OTHERS`; None without blocks."""
    if not blocks:
        return None
    least = np.clip(np.abs(number), 0, _OTHERS).astype(np.uint8)
    return least if before is None else np.minimum(before + least, _OTHERS).astype(np.uint8)
