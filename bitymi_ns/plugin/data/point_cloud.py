"""Whether a capture's point cloud can be used, and how long it takes."""

from __future__ import annotations

import re
import struct
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from pathlib import Path

from bitymi_ns.plugin.console import say
from bitymi_ns.plugin.data.ply import POINTS, bad_line
from bitymi_ns.ply import PlyError, read_header, rows_there

MANY_POINTS = 500_000
"""Work on clouds from this size on is announced, and timed."""


def what_is_wrong_with(path: Path) -> str | None:
    """Why the file is no whole PLY file of points, in words that follow its name; None = nothing."""
    try:
        header = read_header(path)
        points = header.elements.get(POINTS)
        if points is None:
            return f"declares no points (element {POINTS})"
        missing = [name for name in "xyz" if name not in points.names]
        if missing:
            return f"gives no {' and no '.join(missing)} of its points (property float {missing[0]})"
        there = rows_there(path, header, POINTS)
        if there is not None and there < points.count:
            return f"is cut off: it has {there} of {points.count} points"
        line = _bad_line(path, path.stat().st_mtime_ns)
    except PlyError as error:
        return f"is {error}" if str(error).startswith("not ") else f"is damaged, no points can be read: {error}"
    except OSError as error:
        return f"cannot be read: {error}"
    return None if line is None else f"is damaged: {line}"


@lru_cache(maxsize=2)
def _bad_line(path: Path, changed: int) -> str | None:
    """The first line that is no point. A capture is checked twice before it is read, which would take seconds."""
    return bad_line(path, read_header(path))


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
        points = read_header(path).elements.get(POINTS)
        return 0 if points is None else points.count
    except (OSError, struct.error, PlyError):
        return 0


@contextmanager
def reporting_time(what: str, points: int) -> Iterator[None]:
    """Say what is done with many points before it begins, and how long it took."""
    if points < MANY_POINTS:
        yield
        return
    say(f"{what} {points:,} points. This may take minutes.")
    start = time.perf_counter()
    yield
    say(f"{what} {points:,} points took {time.perf_counter() - start:.1f} s.")
