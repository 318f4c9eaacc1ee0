"""Integer columns as Zstandard frames: one frame per byte plane, of known size."""

from collections.abc import Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import zstandard

from bitymi_ns.ops.backend import load

LEVEL = 19
MOST_PLANES = 7  # bytes of an integer that a float64 holds exactly
_WINDOW = 1 << 23


class StreamError(ValueError):
    """Bytes that do not match their description."""


@dataclass(frozen=True)
class Compressed:
    """A compressed integer column of n numbers per row."""

    low: list[int]  # [n] smallest value of each number, subtracted before packing
    planes: list[list[int]]  # [n] byte sizes of the frames, lowest byte first; empty if all values are equal
    data: bytes  # concatenated frames


def compress(codes: npt.NDArray[np.int64], level: int = LEVEL) -> Compressed:
    """Compress int64 [rows, n] of magnitude below 2^53; `level` is Zstandard's, 1 to 22."""
    low = [int(column.min()) if len(column) else 0 for column in codes.T]
    planes: list[list[Future[bytes]]] = []
    with ThreadPoolExecutor(load("_cpu").num_threads()) as pool:
        for column, least in zip(codes.T, low, strict=True):
            rest = (column - least).astype(np.uint64)
            planes.append([])
            while rest.any():
                plane = (rest & np.uint64(255)).astype(np.uint8).tobytes()
                planes[-1].append(pool.submit(zstandard.compress, plane, level))
                rest = rest >> np.uint64(8)
    frames = [[plane.result() for plane in number] for number in planes]
    return Compressed(low, [[len(f) for f in number] for number in frames], b"".join(f for n in frames for f in n))


def decompress(
    view: memoryview, rows: int, low: Sequence[int], planes: Sequence[Sequence[int]], dtype: type[np.integer] = np.int64
) -> npt.NDArray:
    """Decompress the integers [rows, n] of `compress`, in memory bounded by `rows`.

    Raises:
        StreamError: a frame is damaged or its size does not match `rows`.
    """
    codes = np.empty((rows, len(low)), dtype=dtype)
    at = 0
    for number, sizes in enumerate(planes):
        column = np.zeros(rows, dtype=dtype)
        for plane, size in enumerate(sizes):
            column += plane_bytes(view[at : at + size], rows).astype(dtype) << (8 * plane)
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
