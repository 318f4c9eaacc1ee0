"""Point clouds: PLY files validated and read, colored by photographs where they have no colors, and projected into
these to detect poses in another convention.

The PLY reader that nerfstudio uses returns uninitialized memory for points that the file lacks, and divides every color
by 255, also those in [0, 1].
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from bitymi_ns.capture.camera import OPENCV_AXES, Photograph, Pose
from bitymi_ns.capture.images import read_image
from bitymi_ns.capture.types import fail, say, warn
from bitymi_ns.ply import PlyError, read_header, read_rows, rows_there, text_lines
from bitymi_ns.ranges import spread

VERTEX = "vertex"
COLOR_NAMES = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
"""Property names by which programs write colors."""
MANY_POINTS = 500_000  # number of points from which on slow steps are announced and timed
COLOR_VIEWS = 24  # photographs, spread over all, in which colors are looked up
COLOR_CHUNK = 100_000  # points that are colored together
GREY = 128
CHECK_VIEWS = 8  # photographs, spread over all, into which points are projected to check conventions
CHECK_POINTS = 2000
CHECK_SIZE = 800  # pixels at least to which large JPEG files are downscaled as they are decoded for that check
NOTHING, SOMETHING = 0.01, 0.1
"""Share of the points that a picture shows by poses that are wrong, and by such as may be right."""
MANY_TIMES, MORE_ALIKE = 2.5, 0.05
"""Poses that show so many times as many points, with a correlation of brightness that is so much higher, are the right
ones. In three real captures the right ones show 70 to 76 % of the points with a correlation of 0.21 to 0.56, all others
at most 24 % with 0.12."""
ALIKE = 0.4
"""With a correlation so much higher, poses are the right ones however few points they show: a room has points on all
sides."""


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


def read_cloud(path: Path, without: str) -> tuple[Points, str]:
    """Read the points of a PLY file, see `read_points`; `without` says how to do without it.

    Raises:
        CaptureError: it is missing, or cannot be read.
    """
    fault = ply_fault(path) if path.is_file() else "does not exist"
    if fault is not None:
        fail(f"the point cloud {path} {fault}. Put it there again, or {without} to start from random points.")
    try:
        return read_points(path)
    except PlyError as error:
        fail(f"the point cloud {path} cannot be read: {error}. Write its points without lists.", error)


def with_colors(points: Points, without: str, photographs: Sequence[Photograph], source: Path) -> Points:
    """Color points in the frame of the photographs that have no colors, for the reason `without`; see
    `color_points`."""
    if not without and not points.rgb.any():
        without = "its own are all black"
    if not without or not len(points.xyz):
        return points
    say(f"The points of {source} get the colors of the photographs that see them: {without}.")
    return color_points(points, photographs)


def color_points(points: Points, photographs: Sequence[Photograph]) -> Points:
    """Color each point by the median over the photographs it projects into; grey where there is none. A median is
    robust to the photographs in which the point is occluded."""
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
    """Look up the colors [N, 3] of points [N, 3] in an image [H, W, 3]; NaN outside of it."""
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


def _from_xyzw(pose: Pose) -> Pose:
    """Camera to world of a COLMAP model with quaternions x, y, z, w that were read as w, x, y, z."""
    read = np.linalg.inv(pose @ OPENCV_AXES)
    meant = np.eye(4)  # SciPy's order is x, y, z, w
    meant[:3, :3] = Rotation.from_quat(Rotation.from_matrix(read[:3, :3]).as_quat()[[3, 0, 1, 2]]).as_matrix()
    meant[:3, 3] = read[:3, 3]
    return np.linalg.inv(meant) @ OPENCV_AXES


JSON_CONVENTIONS: dict[str, Callable[[Pose], Pose]] = {
    "the cameras have OpenCV's axes (y down, z forward): negate the second and third column": lambda pose: (
        pose @ OPENCV_AXES
    ),
    "they are world to camera: invert them": np.linalg.inv,
    "they are world to camera with OpenCV's axes: invert them, then negate the second and third column": lambda pose: (
        np.linalg.inv(pose) @ OPENCV_AXES
    ),
    "they are left-handed, as Unity's: negate the third column": lambda pose: pose @ np.diag([1.0, 1.0, -1.0, 1.0]),
}
"""Other conventions of a matrix in a transforms.json, which should be camera to world with OpenGL axes, and the
conversion of a pose that was read as such."""
COLMAP_CONVENTIONS: dict[str, Callable[[Pose], Pose]] = {
    "the cameras have OpenGL's axes (y up, z backward)": lambda pose: pose @ OPENCV_AXES,
    "they are camera to world: invert them": lambda pose: OPENCV_AXES @ np.linalg.inv(pose) @ OPENCV_AXES,
    "they are camera to world with OpenGL's axes": lambda pose: OPENCV_AXES @ np.linalg.inv(pose),
    "the quaternions are in the order x, y, z, w: write w first": _from_xyzw,
}
"""The same for a COLMAP model, whose poses should be world to camera with OpenCV axes."""


class _Fit(NamedTuple):
    """Share of the points that project into a picture, and correlation of their brightness with its; 0 without
    colors."""

    share: float
    correlation: float


def check_conventions(
    points: Points,
    photographs: Sequence[Photograph],
    conventions: dict[str, Callable[[Pose], Pose]],
    source: str,
    frame: Pose | None = None,
) -> None:
    """Warn where the points are not seen by the poses as they are read, but would be by another of these conventions.
    `frame` [4, 4] is from the frame in which the poses were written to that of points and photographs; None = the
    same."""
    rgb = points.rgb if len(points.rgb) == len(points.xyz) else np.zeros((len(points.xyz), 3), np.uint8)
    kept = np.flatnonzero(np.isfinite(points.xyz).all(1))
    kept = kept[:: max(1, len(kept) // CHECK_POINTS)]
    if len(kept) < 20:
        return
    back = np.eye(4) if frame is None else np.linalg.inv(frame)
    xyz = points.xyz[kept] @ back[:3, :3].T + back[:3, 3]
    chosen = [photographs[i] for i in spread(len(photographs), CHECK_VIEWS)]
    images = [_small_image(photograph) for photograph in chosen]

    def fit(convention: Callable[[Pose], Pose]) -> _Fit:
        cameras = [replace(each, pose=convention(back @ each.pose)) for each in chosen]
        seen = np.stack([sample_colors(xyz, *each) for each in zip(cameras, images, strict=True)])
        inside = np.isfinite(seen[..., 0])
        share = float(inside.mean())
        own = np.broadcast_to(rgb[kept].astype(float).mean(-1), inside.shape)[inside]
        theirs = seen.mean(-1)[inside]
        if len(own) < 20 or own.std() < 1.0 or theirs.std() < 1.0:
            return _Fit(share, 0.0)
        return _Fit(share, float(np.corrcoef(own, theirs)[0, 1]))

    read = fit(lambda pose: pose)
    fits = {name: fit(convention) for name, convention in conventions.items()}
    best = max(fits, key=lambda name: fits[name].share * max(fits[name].correlation, NOTHING))
    better = fits[best].correlation - read.correlation
    unseen = read.share < NOTHING and fits[best].share > SOMETHING
    rare = fits[best].share > max(SOMETHING, MANY_TIMES * read.share) and better > MORE_ALIKE
    if unseen or rare or (fits[best].share > NOTHING and fits[best].correlation > ALIKE and better > ALIKE):
        what = "are in next to none of the photographs" if unseen else "do not look like the photographs in their place"
        warn(
            f"{source}: by its poses its points {what}; they would if the poses were written in another convention: "
            f"{best}. As they are, the scene will be wrong."
        )


def _small_image(photograph: Photograph) -> npt.NDArray[np.uint8]:
    camera = photograph.camera
    scale = CHECK_SIZE / max(camera.width, camera.height)
    wanted = (round(camera.width * scale), round(camera.height * scale)) if scale < 1.0 else None
    return np.asarray(read_image(photograph.file, wanted=wanted).convert("RGB"))
