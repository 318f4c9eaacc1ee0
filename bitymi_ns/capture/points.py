"""Point clouds: validate and read PLY files, and color points by photographs.

nerfstudio's PLY reader returns uninitialized memory for missing points, and divides all colors by 255, even those in
[0, 1].
"""

import os
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from bitymi_ns.capture.image_files import read_image
from bitymi_ns.capture.types import Photograph, fail, say
from bitymi_ns.ply import PlyError, read_header, read_rows, rows_there, text_lines
from bitymi_ns.ranges import spread

VERTEX = "vertex"
COLOR_NAMES = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
"""Names of color properties in PLY files."""
MANY_POINTS = 500_000  # points from which on slow steps are announced and timed
COLOR_VIEWS = 24  # photographs, spread over all, in which colors are looked up
COLOR_CHUNK = 100_000  # points that are colored together
GREY = 128


class Points(NamedTuple):
    """Initial points: positions [N, 3] float64 and colors [N, 3] uint8, [0, 3] without colors."""

    xyz: npt.NDArray[np.float64]
    rgb: npt.NDArray[np.uint8]


def read_points(path: Path) -> tuple[Points, str]:
    """Read the points of a PLY file in which `ply_fault` finds none, and the reason, a clause, why they have no colors;
    empty if they have. Raises PlyError: its points have list properties, or follow an element with some."""
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
    """Convert colors [N, 3] to bytes. White is the smallest number that bounds them: 1 or 255 if `floating`, else 255
    or 65535. Return [0, 3] and the reason if none does. Non-finite `values` become 0 in place."""
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
    """Describe why a file is no complete PLY file of points, in words that follow its name; None = it is."""
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


@lru_cache(maxsize=2)  # captures are checked twice, which takes seconds for large clouds
def _bad_line(path: Path, changed: int) -> str | None:
    """Describe the fault of a text file's first line that is no point; None = none."""
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
    """Announce and time a step on many points."""
    if points < MANY_POINTS:
        yield
        return
    say(f"{what} {points:,} points. This may take minutes.")
    start = time.perf_counter()
    yield
    say(f"{what} {points:,} points took {time.perf_counter() - start:.1f} s.")


def read_cloud(path: Path, remedy: str) -> tuple[Points, str]:
    """Read a PLY file, see `read_points`. Raises CaptureError: it is missing, or cannot be read; `remedy` says what to
    do."""
    fault = ply_fault(path) if os.path.isfile(path) else "does not exist"
    if fault is not None:
        fail(f"the point cloud {path} {fault}. {remedy}")
    try:
        return read_points(path)
    except PlyError as error:
        fail(f"the point cloud {path} cannot be read: {error}. Write its points without lists.", error)


def with_colors(points: Points, without: str, photographs: Sequence[Photograph], source: Path) -> Points:
    """Color points that have no colors, for the reason `without`, or black ones only; see `color_points`."""
    if not without and not points.rgb.any():
        without = "its own are all black"
    if not without or not len(points.xyz):
        return points
    say(f"The points of {source} get the colors of the photographs that see them: {without}.")
    return color_points(points, photographs)


def color_points(points: Points, photographs: Sequence[Photograph]) -> Points:
    """Color each point by the median over those of `COLOR_VIEWS` photographs that it projects into, robust to those in
    which it is hidden; grey if it projects into none."""
    chosen = [photographs[i] for i in spread(len(photographs), COLOR_VIEWS)]
    images = [np.asarray(read_image(photograph.file).convert("RGB")) for photograph in chosen]
    rgb = np.full((len(points.xyz), 3), GREY, np.uint8)
    for start in range(0, len(rgb), COLOR_CHUNK):
        xyz = points.xyz[start : start + COLOR_CHUNK]
        seen = np.stack([sample_colors(xyz, *each) for each in zip(chosen, images, strict=True)])
        known = np.isfinite(seen[..., 0]).any(0)
        rgb[start : start + COLOR_CHUNK][known] = np.nanmedian(seen[:, known], 0).astype(np.uint8)
    return Points(points.xyz, rgb)


def sample_colors(
    xyz: npt.NDArray[np.float64], photograph: Photograph, image: npt.NDArray[np.uint8]
) -> npt.NDArray[np.float32]:
    """Look up colors [N, 3] of points [N, 3] in an image [H, W, 3]; NaN outside."""
    camera = photograph.camera
    colors = np.full((len(xyz), 3), np.nan, np.float32)
    local = (xyz - photograph.pose[:3, 3]) @ photograph.pose[:3, :3] * [1.0, -1.0, -1.0]
    lens = camera.colmap
    front = np.flatnonzero(lens.is_spherical() | (local[:, 2] > 0.0))
    if not len(front):
        return colors
    pixels = lens.img_from_cam(local[front] / np.abs(local[front, 2:]).clip(min=1e-12))
    height, width = image.shape[:2]
    pixels = np.nan_to_num(pixels * np.divide((width, height), camera.size), nan=-1.0, posinf=-1.0, neginf=-1.0)
    inside = ((pixels >= 0.0) & (pixels < (width, height))).all(1)
    x, y = pixels[inside].astype(int).T
    colors[front[inside]] = image[y, x]
    return colors
