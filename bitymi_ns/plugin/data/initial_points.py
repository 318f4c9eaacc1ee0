"""Initial points of training: those of the capture, triangulated ones, or random ones; colored by the photographs where
they have no colors, and projected into these to detect poses in another convention."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from bitymi_ns.capture.types import CaptureError
from bitymi_ns.plugin.console import fail, say, warn
from bitymi_ns.plugin.data.colmap_model import read_model
from bitymi_ns.plugin.data.images import image_size, read_image
from bitymi_ns.plugin.data.point_files import Points, ply_fault, read_points
from bitymi_ns.plugin.data.views import OPENCV_AXES, Photograph, Pose
from bitymi_ns.ply import PlyError
from bitymi_ns.train.views import spread

Choice = Literal["auto", "triangulate", "random"]
"""auto = those of the capture, triangulated ones where it has none; triangulate = in any case; random = in any case."""
MIRROR = np.diag([1.0, 1.0, -1.0])
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

_wanted: ContextVar[bool] = ContextVar("points_wanted", default=False)


@contextmanager
def reading_points(wanted: bool) -> Iterator[None]:
    """Read captures for a scene that starts from points, if `wanted`. Evaluation and the viewer spend no time on
    them."""
    token = _wanted.set(wanted)
    try:
        yield
    finally:
        _wanted.reset(token)


def points_wanted() -> bool:
    """True if the capture is read for a scene that starts from points."""
    return _wanted.get()


def initial_points(
    own: Points | None, choice: Choice, photographs: Sequence[Photograph], folder: Path, source: str
) -> Points | None:
    """Choose the points to start from: the capture's `own`, or triangulated ones, which are kept in its `folder`; None
    = random ones. `source` of the poses is for messages."""
    if choice == "random":
        return None
    if own is not None and len(own.xyz) and choice == "auto":
        return own
    return triangulated(photographs, folder, source) if points_wanted() else None


def triangulated(photographs: Sequence[Photograph], folder: Path, source: str) -> Points | None:
    """Triangulate points from photographs with poses; None (with a warning) where that is not possible."""
    from bitymi_ns.capture.known_poses import KnownView, triangulate  # slow to import, and seldom needed
    from bitymi_ns.progress import rich_progress

    middle = np.mean([photograph.pose[:3, 3] for photograph in photographs], axis=0)
    mirrored = [bool(np.linalg.det(photograph.pose[:3, :3]) < 0.0) for photograph in photographs]
    mirror = MIRROR if all(mirrored) else np.eye(3)  # the photographs of a mirrored capture are not mirrored
    views = []
    for photograph in photographs:
        camera = photograph.camera
        stored = (photograph.downscaled and image_size(photograph.file)) or camera.size
        c2w = photograph.pose @ OPENCV_AXES
        rotation = (mirror @ c2w[:3, :3]).T
        translation = -rotation @ mirror @ (c2w[:3, 3] - middle)
        pose = np.column_stack([rotation, translation])
        views.append(KnownView(photograph.file, camera.rescaled(*stored), pose, photograph.mask))
    say(f"{source} has no points: they are triangulated from the photographs, once. --points random does without.")
    try:
        if any(mirrored) and not all(mirrored):
            raise CaptureError("some poses are mirrored against the others")
        with rich_progress() as progress:
            model = read_model(triangulate(folder, views, progress, warn))
    except CaptureError as error:
        warn(f"No points can be triangulated: {error}. Training starts from random points.")
        return None
    say(f"{len(model.xyz):,} points have been triangulated; they are kept for later runs.")
    return Points(model.xyz @ mirror + middle, model.rgb)


def read_colored_points(path: Path, without: str, photographs: Sequence[Photograph]) -> Points:
    """Read the points of a PLY file, with colors from the photographs where it has none; see `with_colors`. `without`
    says how to do without it."""
    fault = ply_fault(path) if path.is_file() else "does not exist"
    if fault is not None:
        fail(f"the point cloud {path} {fault}. Put it there again, or {without} to start from random points.")
    try:
        points, without_colors = read_points(path)
    except PlyError as error:
        fail(f"the point cloud {path} cannot be read: {error}. Write its points without lists.", error)
    return with_colors(points, without_colors, photographs, path)


def with_colors(points: Points, without: str, photographs: Sequence[Photograph], source: Path) -> Points:
    """Color points in the frame of the photographs that have no colors, for the reason `without`, by `color_points`,
    where a scene starts from them."""
    if not without and not points.rgb.any():
        without = "its own are all black"
    if not without or not len(points.xyz) or not points_wanted():
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
