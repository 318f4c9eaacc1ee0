"""Integer columns as bytes: entropy-coded since version 5, a Zstandard frame per byte plane before."""

import math
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import zstandard

from bitymi_ns.ops.backend import load

MOST_PLANES = 7  # bytes of an integer that a float64 holds exactly
_WINDOW = 1 << 23
Others = npt.NDArray[np.uint8] | None  # [rows] sums of the magnitudes of a row's earlier numbers
_OTHERS = 2  # largest context from a row's earlier numbers


class StreamError(ValueError):
    """Bytes that do not match their description."""


@dataclass(frozen=True)
class Compressed:
    """A compressed integer column."""

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


def decompress(view: memoryview, rows: int, sizes: Sequence[int], blocks: int = 0) -> npt.NDArray[np.int64]:
    """Decompress what `compress` returned to int64 [rows, n]; rows are coefficients x blocks if there are `blocks`.

    Raises:
        StreamError: the bytes are damaged or do not match `rows` and `sizes`.
    """
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
    """Add a number's magnitudes [rows] to the sums of those before it, clipped at `_OTHERS`; None without blocks."""
    if not blocks:
        return None
    least = np.clip(np.abs(number), 0, _OTHERS).astype(np.uint8)
    return least if before is None else np.minimum(before + least, _OTHERS).astype(np.uint8)


def decompress_planes(
    view: memoryview, rows: int, low: Sequence[int], planes: Sequence[Sequence[int]]
) -> npt.NDArray[np.int64]:
    """Decompress a column [rows, n] of versions 3 and 4, byte plane by byte plane.

    Args:
        view: a Zstandard frame per byte plane, number after number.
        low: smallest value of each number.
        planes: bytes of each number's frames, least significant plane first.

    Raises:
        StreamError: a frame is damaged or its size does not match `rows`.
    """
    codes = np.empty((rows, len(low)), dtype=np.int64)
    at = 0
    for number, sizes in enumerate(planes):
        column = np.zeros(rows, dtype=np.int64)
        for plane, size in enumerate(sizes):
            column += plane_bytes(view[at : at + size], rows).astype(np.int64) << (8 * plane)
            at += size
        codes[:, number] = column + low[number]
    if at != len(view):
        raise StreamError(f"the frames have {at} bytes, not {len(view)}")
    return codes


def plane_bytes(frame: memoryview, size: int) -> npt.NDArray[np.uint8]:
    """Decompress a frame of exactly `size` bytes; its header is checked before allocating.

    Raises:
        StreamError: the frame is damaged or has another size.
    """
    try:
        header = zstandard.get_frame_parameters(bytes(frame[:32]))
        if header.content_size != size or header.dict_id or header.window_size > max(_WINDOW, size):
            raise StreamError(f"a frame declares {header.content_size} bytes, {size} are wanted")
        decompressor = zstandard.ZstdDecompressor(max_window_size=max(_WINDOW, 1 << max(10, size.bit_length())))
        data = decompressor.decompress(bytes(frame), max_output_size=size, allow_extra_data=False)
    except zstandard.ZstdError as error:
        raise StreamError(f"a frame is damaged ({error})") from error
    if len(data) != size:
        raise StreamError(f"a frame holds {len(data)} bytes, {size} are wanted")
    return np.frombuffer(data, np.uint8)
