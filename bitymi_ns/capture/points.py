"""Point clouds. nerfstudio's PLY reader returns uninitialized memory for missing points, and divides colors by 255."""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from bitymi_ns.ply import read_header, read_rows
from bitymi_ns.ranges import spread
from .folder_contents import kind_of
from .image_files import WHITES, read_image, to_bytes
from .kinds import CLOUDS
from .types import CaptureError, Photograph, parsing, say

Array = npt.NDArray[np.float64]
VERTEX = "vertex"
COLOR_NAMES = (("red", "green", "blue"), ("diffuse_red", "diffuse_green", "diffuse_blue"), ("r", "g", "b"))
COLOR_VIEWS = 24  # photographs in which colors are looked up
COLOR_SIDE = 1000  # longer side that these are reduced to, pixels
COLOR_CHUNK = 100_000  # points that are colored together
GREY = 128
STEP = 0.1  # of the distance from a camera
MOST_COMPARED = 1_000_000  # points of a cloud
SAME = 0.5
"""Least share of triangulated points on the surfaces of a used cloud: at least 0.6 of right ones, else 0.4 at most."""


class Points(NamedTuple):
    xyz: npt.NDArray[np.float64]
    rgb: npt.NDArray[np.uint8]


def color_bytes(values: npt.NDArray[np.float64], floating: bool) -> tuple[npt.NDArray[np.uint8], str]:
    """Convert colors [N, 3] to bytes, else to [0, 3] with the reason. Non-finite `values` become 0 in place."""
    values[~np.isfinite(values)] = 0.0
    try:
        return to_bytes(values, WHITES[floating], "colors") if len(values) else values.astype(np.uint8), ""
    except ValueError as error:
        return np.zeros((0, 3), np.uint8), str(error)


def read_cloud(path: Path, remedy: str) -> tuple[Points, str]:
    """Read the points of a PLY file, and why they have no colors (empty if they have). Raises CaptureError with
    `remedy`."""
    with parsing(f"the point cloud {path}", remedy):
        header = read_header(path)
        points = header.elements.get(VERTEX)
        names = () if points is None else points.names
        if missing := [name for name in "xyz" if name not in names]:
            raise ValueError(f"it gives no {' and no '.join(missing)} of its points (property float {missing[0]})")
        rows = read_rows(path, header, VERTEX)
    xyz = np.stack([rows[name] for name in "xyz"], -1).astype(np.float64)
    colors = next((color for color in COLOR_NAMES if set(color) <= set(names)), None)
    if colors is None:
        return Points(xyz, np.zeros((0, 3), np.uint8)), "its points have none"
    values = np.stack([rows[name] for name in colors], -1)
    if values.dtype == np.uint8:
        return Points(xyz, values), ""
    rgb, without = color_bytes(values.astype(np.float64), values.dtype.kind == "f")
    return Points(xyz, rgb), without


def share_on(cloud: Array, points: Array, centers: Array) -> float:
    """Measure the share of points [N, 3] on surfaces of a cloud [M, 3]: it lies nearer to them than to where they are
    by STEP nearer to, or farther from, the nearest of the cameras [K, 3]. By chance a third."""
    tree = cKDTree(cloud[np.isfinite(cloud).all(1)][:: 1 + len(cloud) // MOST_COMPARED])
    step = STEP * (centers[cKDTree(centers).query(points)[1]] - points)
    here, nearer, farther = (tree.query(points + sign * step)[0] for sign in (0.0, 1.0, -1.0))
    return float((here < np.minimum(nearer, farther)).mean())


def cloud_beside(
    folder: Path, points: Points | None, photographs: Sequence[Photograph], placed: Callable[[Points], Points]
) -> Points | None:
    """Read the first PLY file in a folder on whose surfaces most of the triangulated `points` lie; None = none.
    `placed` moves points of files to the poses' world. Report others."""
    centers = np.stack([each.pose[:3, 3] for each in photographs])
    for path in sorted(path for path in folder.iterdir() if kind_of(path, CLOUDS)):
        try:
            cloud, without = read_cloud(path, "")
        except CaptureError as error:
            say(f"Not used: {error}")
            continue
        cloud = placed(cloud)
        share = 0.0 if points is None or not len(cloud.xyz) else share_on(cloud.xyz, points.xyz, centers)
        why = f"{share:.0%} of the triangulated points lie on its surfaces"
        if share > SAME:
            say(f"Training starts from the points of {path}, which nothing names: {why}.")
            return with_colors(cloud, without, photographs, path)
        say(f"{path}, which nothing names, is not used: {why}. `bitymi-data --ply-path {path.name}` uses it.")
    return None


def with_colors(points: Points, without: str, photographs: Sequence[Photograph], source: Path) -> Points:
    """Color points that have no colors, for the reason `without`, or only black ones."""
    if not without and not points.rgb.any():
        without = "its own are all black"
    if not without or not len(points.xyz):
        return points
    say(f"The points of {source} get the colors of the photographs that see them: {without}.")
    return color_points(points, photographs)


def color_points(points: Points, photographs: Sequence[Photograph]) -> Points:
    """Color each point by the median over those of COLOR_VIEWS photographs that it projects into; grey without any."""
    chosen = [photographs[i] for i in spread(len(photographs), COLOR_VIEWS)]
    reduced = (read_image(each.file, wanted=each.camera.within(COLOR_SIDE)) for each in chosen)
    images = [np.asarray(image.convert("RGB")) for image in reduced]
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
    camera, (height, width) = photograph.camera, image.shape[:2]
    local = (xyz - photograph.pose[:3, 3]) @ photograph.pose[:3, :3] * [1.0, -1.0, -1.0]
    pixels = camera.pixels_of(local / np.abs(local[:, 2:]).clip(min=1e-12))  # NaN behind the camera
    pixels = np.nan_to_num(pixels * np.divide((width, height), camera.size), nan=-1.0, posinf=-1.0, neginf=-1.0)
    inside = ((pixels >= 0.0) & (pixels < (width, height))).all(1)
    x, y = pixels[inside].astype(int).T
    colors = np.full((len(xyz), 3), np.nan, np.float32)
    colors[inside] = image[y, x]
    return colors
