"""Sizes of maps from their headers: a file of a few bytes can declare more numbers than memory holds."""

import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import IO
from zipfile import ZipFile

import numpy as np
import numpy.typing as npt
from PIL import TiffImagePlugin

from bitymi_ns.capture.pictures import open_picture
from bitymi_ns.reading import open_regular

Check = Callable[[tuple[int, ...]], None]
"""Receives the shape that a header declares, and raises where it must not be read."""
TIFFS = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
EXR = b"v/1\x01"


def read_array(path: Path, check: Check) -> npt.NDArray[np.generic]:
    """Read a .npy file, or the first array of a .npz file, if `check` lets its shape pass.

    Raises:
        OSError, ValueError: it cannot be read, is no array of numbers, or ends before its last number.
    """
    with open_regular(path) as file:
        if path.suffix.lower() != ".npz":
            return _array(file, check)
        with ZipFile(file) as archive, archive.open(archive.namelist()[0]) as part:
            return _array(part, check)


def _array(file: IO[bytes], check: Check) -> npt.NDArray[np.generic]:
    version = np.lib.format.read_magic(file)
    if version not in ((1, 0), (2, 0)):
        raise ValueError(f"it is of version {version[0]} of the format, which is for tables")
    read_header = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
    shape, by_columns, dtype = read_header(file)
    if dtype.kind not in "iuf":
        raise ValueError(f"it holds no numbers, but {dtype}")
    check(shape)
    values = np.frombuffer(_whole(file, int(np.prod(shape, dtype=object)) * dtype.itemsize), dtype)
    return values.reshape(shape, order="F" if by_columns else "C")


def _whole(file: IO[bytes], count: int) -> bytes:
    data = file.read(count)
    if len(data) < count:
        raise ValueError(f"it is cut off: it has {len(data)} of {count} bytes")
    return data


def image_shape(path: Path) -> tuple[int, int]:
    """Read height and width of an image that OpenCV may read, from its header.

    Raises:
        OSError, ValueError: it is no such image.
    """
    with open_regular(path) as file:
        start = file.read(16)
        if start.startswith(EXR):
            file.seek(8)
            return _exr_shape(file)
        if start.startswith(TIFFS):
            entries = TiffImagePlugin.ImageFileDirectory_v2(start if start[2:4] in (b"+\0", b"\0+") else start[:8])
            file.seek(entries.next)
            entries.load(file)
            return int(entries[TiffImagePlugin.IMAGELENGTH]), int(entries[TiffImagePlugin.IMAGEWIDTH])
    with open_picture(path) as image:
        return image.size[1], image.size[0]


def _exr_shape(file: IO[bytes]) -> tuple[int, int]:
    """The data window, among the attributes: names and types that end with 0, sizes, and values."""
    size = os.fstat(file.fileno()).st_size
    while file.tell() < size:
        name, kind = _text(file), _text(file)
        (count,) = struct.unpack("<I", _whole(file, 4))
        if (name, kind, count) == (b"dataWindow", b"box2i", 16):
            left, top, right, bottom = struct.unpack("<4i", _whole(file, 16))
            return bottom - top + 1, right - left + 1
        file.seek(count, os.SEEK_CUR)
    raise ValueError("it has no data window")


def _text(file: IO[bytes]) -> bytes:
    text = b""
    while (letter := _whole(file, 1)) != b"\0":
        text += letter
        if len(text) > 255:
            raise ValueError("a name in its header has no end")
    return text
