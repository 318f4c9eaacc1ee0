"""PLY files of points: rows that are no points, and colours that are no bytes.

The reader that nerfstudio uses reports neither. For points that the file lacks, or that follow one it cannot read, it
returns whatever the memory held. It divides every colour by 255, also those that lie between 0 and 1.
"""

from __future__ import annotations

from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bitymi_ns.ply import Header, PlyError, read_header, read_rows, text_lines

POINTS = "vertex"
"""The element of a point cloud."""
_COLOURS = ("red", "green", "blue")
_NAMES = (_COLOURS, ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
"""What programs call the colours of points."""


class Points(NamedTuple):
    """Points to start from: positions [N, 3] float64, and colours [N, 3] uint8, or [0, 3] where they have none."""

    xyz: npt.NDArray[np.float64]
    rgb: npt.NDArray[np.uint8]


def read_points(path: Path) -> tuple[Points, str]:
    """The points of a file that `point_cloud.what_is_wrong_with` finds nothing wrong with.

    Returns:
        the points, and why they have no colours, in words that follow the name of the file; empty where they have.

    Raises:
        PlyError: its points have lists, or stand behind some.
    """
    header = read_header(path)
    rows = read_rows(path, header, POINTS)
    xyz = np.stack([rows[name] for name in "xyz"], -1).astype(np.float64)
    names = next((names for names in _NAMES if set(names) <= set(header.elements[POINTS].names)), None)
    if names is None:
        return Points(xyz, np.zeros((0, 3), np.uint8)), "its points have none"
    values = np.stack([rows[name] for name in names], -1)
    if values.dtype == np.uint8:
        return Points(xyz, values), ""
    rgb = as_bytes(values.astype(np.float64), values.dtype.kind == "f")
    if isinstance(rgb, str):
        return Points(xyz, np.zeros((0, 3), np.uint8)), rgb
    return Points(xyz, rgb), ""


def bad_line(path: Path, header: Header) -> str | None:
    """The first line of a text file that is no point, in words; None = none."""
    points = header.elements[POINTS]
    if header.order or points.row is None or not points.count:
        return None
    try:
        values = read_rows(path, header, POINTS)
        if not any(np.isinf(values[name]).any() for name in points.names):
            return None
    except PlyError:
        pass
    types = [points.row[name] for name in points.names]
    for number, line in islice(text_lines(path, header, POINTS), points.count):
        words = line.split()
        if len(words) != len(types):
            return f"line {number} has {len(words)} numbers, but its points have {len(types)}"
        for word, name, kind in zip(words, points.names, types, strict=True):
            if not _fits(word, kind):
                return f"line {number} has {word[:30]!r} for {name}, which is no number of that kind ({kind.name})"
    return None


def colours(path: Path) -> npt.NDArray[np.uint8] | str | None:
    """Colours [N, 3] of points whose file has them as other than bytes, by which white they fit.

    Returns:
        None = they are bytes, or there are none; text = why they cannot be told.
    """
    try:
        header = read_header(path)
        points = header.elements.get(POINTS)
        if points is None or not points.count or not set(_COLOURS) <= set(points.names):
            return None
        if points.row is None or all(points.row[name] == np.uint8 for name in _COLOURS):
            return None  # the reader's stand
        rows = read_rows(path, header, POINTS)
    except PlyError:
        return None
    values = np.stack([rows[name] for name in _COLOURS], -1)
    return as_bytes(values.astype(np.float64), any(points.row[name].kind == "f" for name in _COLOURS))


def as_bytes(values: npt.NDArray[np.float64], floating: bool) -> npt.NDArray[np.uint8] | str:
    """Colours as bytes, by which white they fit; or why they cannot be told. `floating`: they may lie in 0 to 1."""
    if not len(values):
        return np.zeros((0, 3), np.uint8)
    values[~np.isfinite(values)] = 0.0
    low, high = values.min(), values.max()
    white = next((white for white in ((1.0, 255.0) if floating else (255.0, 65535.0)) if high <= white), None)
    if white is None or low < 0.0:
        return f"its colours lie between {low:g} and {high:g}, which is neither 0 to 1 nor 0 to 255 nor 0 to 65535"
    return np.uint8(values * (255.0 / white) + 0.5)


def _fits(word: str, kind: np.dtype) -> bool:
    try:
        if kind.kind == "f":
            return not abs(float(word)) > float(np.finfo(kind).max)
        return np.iinfo(kind).min <= int(word) <= np.iinfo(kind).max
    except ValueError:
        return False
