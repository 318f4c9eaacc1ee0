"""Point clouds in PLY files: positions and colors, validated.

The PLY reader that nerfstudio uses returns uninitialized memory for points that the file lacks, and divides every color
by 255, also those in [0, 1].
"""

import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bitymi_ns.plugin.console import say
from bitymi_ns.ply import PlyError, read_header, read_rows, rows_there, text_lines

VERTEX = "vertex"
COLOR_NAMES = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
"""Property names by which programs write colors."""
MANY_POINTS = 500_000  # number of points from which on slow steps are announced and timed


class Points(NamedTuple):
    """Initial points: positions [N, 3] float64, and colors [N, 3] uint8, or [0, 3] where they have none."""

    xyz: npt.NDArray[np.float64]
    rgb: npt.NDArray[np.uint8]


def read_points(path: Path) -> tuple[Points, str]:
    """Read the points of a file in which `ply_fault` finds no fault.

    Returns:
        the points, and why they have no colors, in words that follow "points: "; empty where they have.

    Raises:
        PlyError: its points have lists, or stand behind some.
    """
    header = read_header(path)
    rows = read_rows(path, header, VERTEX)
    xyz = np.stack([rows[name] for name in "xyz"], -1).astype(np.float64)
    names = next((names for names in COLOR_NAMES if set(names) <= set(header.elements[VERTEX].names)), None)
    if names is None:
        return Points(xyz, np.zeros((0, 3), np.uint8)), "its points have none"
    values = np.stack([rows[name] for name in names], -1)
    if values.dtype == np.uint8:
        return Points(xyz, values), ""
    rgb, without = color_bytes(values.astype(np.float64), values.dtype.kind == "f")
    return Points(xyz, rgb), without


def color_bytes(values: npt.NDArray[np.float64], floating: bool) -> tuple[npt.NDArray[np.uint8], str]:
    """Convert colors [N, 3] to bytes by the smallest white (1, 255 or 65535) that bounds them, or to none [0, 3] and
    why that cannot be done. `floating`: white may be 1."""
    none = np.zeros((0, 3), np.uint8)
    if not len(values):
        return none, ""
    values[~np.isfinite(values)] = 0.0
    low, high = values.min(), values.max()
    white = next((white for white in ((1.0, 255.0) if floating else (255.0, 65535.0)) if high <= white), None)
    if white is None or low < 0.0:
        return none, f"its colors lie between {low:g} and {high:g}, which is neither 0 to 1 nor 0 to 255 nor 0 to 65535"
    return np.uint8(values * (255.0 / white) + 0.5), ""


def ply_fault(path: Path) -> str | None:
    """Describe why the file is no complete PLY file of points, in words that follow its name; None = it is one."""
    try:
        header = read_header(path)
        points = header.elements.get(VERTEX)
        if points is None:
            return f"declares no points (element {VERTEX})"
        missing = [name for name in "xyz" if name not in points.names]
        if missing:
            return f"gives no {' and no '.join(missing)} of its points (property float {missing[0]})"
        there = rows_there(path, header, VERTEX)
        if there is not None and there < points.count:
            return f"is cut off: it has {there} of {points.count} points"
        line = _bad_line(path, path.stat().st_mtime_ns)
    except PlyError as error:
        return f"is {error}" if str(error).startswith("not ") else f"is damaged, no points can be read: {error}"
    except OSError as error:
        return f"cannot be read: {error}"
    return None if line is None else f"is damaged: {line}"


@lru_cache(maxsize=2)  # a capture is checked twice before it is read, which takes seconds for large clouds
def _bad_line(path: Path, changed: int) -> str | None:
    """Find the first line of a text file that is no point; None = none."""
    header = read_header(path)
    points = header.elements[VERTEX]
    if header.order or points.row is None or not points.count:
        return None
    try:
        values = read_rows(path, header, VERTEX)
        if not any(np.isinf(values[name]).any() for name in points.names):
            return None
    except PlyError:
        pass
    types = [points.row[name] for name in points.names]
    for number, line in islice(text_lines(path, header, VERTEX), points.count):
        words = line.split()
        if len(words) != len(types):
            return f"line {number} has {len(words)} numbers, but its points have {len(types)}"
        for word, name, kind in zip(words, points.names, types, strict=True):
            if not _fits(word, kind):
                return f"line {number} has {word[:30]!r} for {name}, which is no number of that kind ({kind.name})"
    return None


def _fits(word: str, kind: np.dtype) -> bool:
    try:
        if kind.kind == "f":
            return not abs(float(word)) > float(np.finfo(kind).max)
        return np.iinfo(kind).min <= int(word) <= np.iinfo(kind).max
    except ValueError:
        return False


@contextmanager
def reporting_time(what: str, points: int) -> Iterator[None]:
    """Announce a step on many points, and report the time that it took."""
    if points < MANY_POINTS:
        yield
        return
    say(f"{what} {points:,} points. This may take minutes.")
    start = time.perf_counter()
    yield
    say(f"{what} {points:,} points took {time.perf_counter() - start:.1f} s.")
