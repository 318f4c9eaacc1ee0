"""Columns of integers as Zstandard frames, one for each byte plane of each number, of known sizes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import zstandard

LEVEL = 19
MOST_PLANES = 7  # bytes of a number: what a float64 holds exactly
_WINDOW = 1 << 23


class StreamError(ValueError):
    """The bytes are not what their description says."""


@dataclass(frozen=True)
class Compressed:
    """A compressed column of integers."""

    low: list[int]  # of each of its numbers, the smallest value, which was subtracted
    # of each of its numbers, the sizes in bytes of its frames, the lowest byte first; none where all are 0
    planes: list[list[int]]
    data: bytes  # the frames, one after the other


def compress(codes: npt.NDArray[np.int64], level: int = LEVEL) -> Compressed:
    """Compress int64 [rows, numbers] below 2^53 in size at a Zstandard level of 1 to 22."""
    compressor = zstandard.ZstdCompressor(level=level, write_content_size=True)
    low = [int(column.min()) if len(column) else 0 for column in codes.T]
    frames: list[list[bytes]] = []
    for column, least in zip(codes.T, low, strict=True):
        rest, planes = (column - least).astype(np.uint64), []
        while rest.any():
            planes.append(compressor.compress((rest & np.uint64(255)).astype(np.uint8).tobytes()))
            rest = rest >> np.uint64(8)
        frames.append(planes)
    sizes = [[len(frame) for frame in planes] for planes in frames]
    return Compressed(low, sizes, b"".join(frame for planes in frames for frame in planes))


def decompress(
    view: memoryview, rows: int, low: Sequence[int], planes: Sequence[Sequence[int]], dtype: type[np.integer] = np.int64
) -> npt.NDArray:
    """Decompress integers [rows, numbers] of `compress`, in memory for `rows` of them and no more.

    Raises:
        StreamError: a frame is damaged, or holds another number of bytes than there are rows.
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
    """Bytes of a frame that must hold `size` of them; its header is checked before anything is allocated.

    Raises:
        StreamError: it is damaged or holds another number.
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
