"""Columns of integers as compressed bytes: a Zstandard frame for each byte of each number, of a known size."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import zstandard

LEVEL = 19
MOST_PLANES = 7
"""Bytes of a number: what a float64 holds exactly."""
_WINDOW = 1 << 23


class StreamError(ValueError):
    """The bytes are not what their description says."""


@dataclass(frozen=True)
class Packed:
    """A column of integers, packed.

    Attributes:
        low: of each of its numbers, the smallest value, which was subtracted.
        planes: of each of its numbers, the sizes in bytes of its frames, the lowest byte first; none where all are 0.
        data: the frames, one after the other.
    """

    low: list[int]
    planes: list[list[int]]
    data: bytes


def pack(codes: npt.NDArray[np.int64], level: int = LEVEL) -> Packed:
    """Packs integers [rows, numbers] below 2^53 in size, with an effort of 1 to 22."""
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
    return Packed(low, sizes, b"".join(frame for planes in frames for frame in planes))


def unpack(
    view: memoryview,
    rows: int,
    low: Sequence[int],
    planes: Sequence[Sequence[int]],
    dtype: type[np.integer] = np.int64,
) -> npt.NDArray:
    """The integers [rows, numbers] of what `pack` made; memory for `rows` of them is needed and no more.

    Raises:
        StreamError: a frame is damaged, or holds another number of bytes than there are rows.
    """
    codes = np.empty((rows, len(low)), dtype=dtype)
    at = 0
    for number, sizes in enumerate(planes):
        column = np.zeros(rows, dtype=dtype)
        for plane, size in enumerate(sizes):
            column += unpacked_bytes(view[at : at + size], rows).astype(dtype) << (8 * plane)
            at += size
        codes[:, number] = column + low[number]
    if at != len(view):
        raise StreamError(f"the frames have {at} bytes, not {len(view)}")
    return codes


def unpacked_bytes(frame: memoryview, size: int) -> npt.NDArray[np.uint8]:
    """The bytes of a frame that must hold `size` of them; nothing is allocated before its header has said so.

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


def frames(view: memoryview, sizes: Sequence[int]) -> Iterator[memoryview]:
    """Parts of `view` of these sizes, one after the other."""
    at = 0
    for size in sizes:
        yield view[at : at + size]
        at += size
