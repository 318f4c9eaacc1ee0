"""Colours of points that have none, from the photographs that see them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pycolmap

from bitymi_ns.plugin.console import fail, say
from bitymi_ns.plugin.data.images import read_image
from bitymi_ns.plugin.data.initial_points import are_wanted
from bitymi_ns.plugin.data.ply import Points, read_points
from bitymi_ns.plugin.data.views import Photograph
from bitymi_ns.ply import PlyError
from bitymi_ns.train.views import spread

LOOKED_AT = 24
"""Photographs, spread over all, in which colours are looked up."""
AT_ONCE = 100_000
"""Points that are coloured together."""
GREY = 128


def points_of_file(path: Path, photographs: Sequence[Photograph]) -> Points:
    """The points of a PLY file; those without colours get them of the photographs, where a scene starts from them."""
    try:
        points, without_colours = read_points(path)
    except PlyError as error:
        fail(f"the point cloud {path} cannot be read: {error}. Write its points without lists.", error)
    return with_colours(points, without_colours, photographs, path)


def with_colours(points: Points, without: str, photographs: Sequence[Photograph], where: Path) -> Points:
    """The points, with the colours of the photographs where they have none and a scene starts from them.

    Args:
        points: in the frame of the photographs.
        without: why they have none; empty where they have.
        photographs: see `coloured`.
        where: they are from, for the message.
    """
    if not without and not points.rgb.any():
        without = "its own are all black"
    if not without or not len(points.xyz) or not are_wanted():
        return points
    say(f"The points of {where} get the colours of the photographs that see them: {without}.")
    return coloured(points, photographs)


def coloured(points: Points, photographs: Sequence[Photograph]) -> Points:
    """The points, each with the median of its colours in the photographs whose picture it falls into; grey where there
    is none. What hides a point in some of them does not matter to a median."""
    chosen = [photographs[i] for i in spread(len(photographs), LOOKED_AT)]
    pictures = [np.asarray(read_image(photograph.file).convert("RGB")) for photograph in chosen]
    rgb = np.full((len(points.xyz), 3), GREY, np.uint8)
    for start in range(0, len(rgb), AT_ONCE):
        xyz = points.xyz[start : start + AT_ONCE]
        seen = np.stack([sampled(xyz, *each) for each in zip(chosen, pictures, strict=True)])
        known = np.isfinite(seen[..., 0]).any(0)
        rgb[start : start + AT_ONCE][known] = np.nanmedian(seen[:, known], 0).astype(np.uint8)
    return Points(points.xyz, rgb)


def sampled(
    xyz: npt.NDArray[np.float64], photograph: Photograph, picture: npt.NDArray[np.uint8]
) -> npt.NDArray[np.float32]:
    """[N, 3] colours of points in a picture; NaN where they are not in it."""
    camera = photograph.camera
    found = np.full((len(xyz), 3), np.nan, np.float32)
    local = (xyz - photograph.pose[:3, 3]) @ photograph.pose[:3, :3] * [1.0, -1.0, -1.0]
    front = np.flatnonzero(local[:, 2] > 0.0)
    if not len(front):
        return found
    lens = pycolmap.Camera(model=camera.model, width=camera.width, height=camera.height, params=list(camera.params))
    pixels = lens.img_from_cam(local[front] / local[front, 2:])
    height, width = picture.shape[:2]
    pixels = np.nan_to_num(pixels * [width / camera.width, height / camera.height], nan=-1.0, posinf=-1.0, neginf=-1.0)
    inside = ((pixels >= 0.0) & (pixels < (width, height))).all(1)
    x, y = pixels[inside].astype(int).T
    found[front[inside]] = picture[y, x]
    return found
