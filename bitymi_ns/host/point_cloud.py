"""Whether a capture's point cloud is whole, and how long it takes.

The reader that nerfstudio uses does not say: it returns whatever the memory held for points that the file lacks, and no
points for a file of another kind.
"""

from __future__ import annotations

import re
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from nerfstudio.utils.rich_utils import CONSOLE

MANY_POINTS = 500_000
"""Work on clouds from this size on is announced, and timed."""
_HEADER_LIMIT = 1 << 16
_SIZES = {
    **dict.fromkeys(("char", "uchar", "int8", "uint8"), 1),
    **dict.fromkeys(("short", "ushort", "int16", "uint16"), 2),
    **dict.fromkeys(("int", "uint", "int32", "uint32", "float", "float32"), 4),
    **dict.fromkeys(("double", "float64"), 8),
}


def what_is_wrong_with(path: Path) -> str | None:
    """Why the file is no whole PLY file of points, in words that follow its name; None = nothing."""
    try:
        header = _header(path)
        if header is None:
            return "is not a PLY file"
        lines, body = header
        count, row = _vertices(lines)
        if count is None:
            return "declares no points (element vertex)"
        if ["format", "ascii", "1.0"] in lines:
            with open(path, "rb") as file:
                file.seek(body)
                there = sum(1 for line in file if line.strip())
        elif row is None:
            return None  # its length cannot be told from the header
        else:
            there = (path.stat().st_size - body) // max(1, row)
    except OSError as error:
        return f"cannot be read: {error}"
    return f"is cut off: it has {there} of {count} points" if there < count else None


def point_count(path: Path) -> int:
    """How many points a PLY file or COLMAP's points3D.bin or .txt states; 0 where it states none."""
    try:
        if path.suffix == ".bin":
            with open(path, "rb") as file:
                return int(struct.unpack("<Q", file.read(8))[0])
        if path.suffix == ".txt":
            with open(path, "rb") as file:
                stated = re.search(rb"Number of points: (\d+)", file.read(1000))
            return int(stated[1]) if stated else 0
        header = _header(path)
        return 0 if header is None else _vertices(header[0])[0] or 0
    except (OSError, struct.error):
        return 0


@contextmanager
def reporting_time(what: str, points: int) -> Iterator[None]:
    """Say what is done with many points before it begins, and how long it took."""
    if points < MANY_POINTS:
        yield
        return
    CONSOLE.print(f"{what} {points:,} points. This may take minutes.", soft_wrap=True)
    start = time.perf_counter()
    yield
    CONSOLE.print(f"{what} {points:,} points took {time.perf_counter() - start:.1f} s.", soft_wrap=True)


def _header(path: Path) -> tuple[list[list[str]], int] | None:
    """The words of a PLY file's header, line by line, and where it ends; None for other files."""
    with open(path, "rb") as file:
        head = file.read(_HEADER_LIMIT)
    body = head.find(b"\n", head.find(b"end_header")) + 1
    if not head.startswith(b"ply") or b"end_header" not in head or body == 0:
        return None
    return [line.split() for line in head[:body].decode("ascii", "replace").splitlines()], body


def _vertices(header: list[list[str]]) -> tuple[int | None, int | None]:
    """Number of vertices and bytes of one; None where the header does not tell."""
    elements = [i for i, words in enumerate(header) if words[:1] == ["element"]]
    if not elements or len(header[elements[0]]) != 3:
        return None, None
    _, name, count = header[elements[0]]
    if name != "vertex" or not count.isdecimal():
        return None, None
    end = elements[1] if len(elements) > 1 else len(header)
    sizes = [_SIZES.get(words[1]) for words in header[elements[0] + 1 : end] if words[:1] == ["property"]]
    return int(count), None if None in sizes else sum(size or 0 for size in sizes)
