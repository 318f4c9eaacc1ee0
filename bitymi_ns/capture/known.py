"""A point cloud for photographs whose poses are known."""

from __future__ import annotations

import shutil
import warnings
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bitymi_ns.capture.cache import content_key, work_folder
from bitymi_ns.capture.photos import check_names
from bitymi_ns.capture.sfm import process
from bitymi_ns.capture.sfm.job import MODEL, CameraGroup, Job
from bitymi_ns.capture.types import CaptureError
from bitymi_ns.files import Tell, explained, write_file
from bitymi_ns.progress import Progress, no_progress

DONE = "points"
"""File that is written when the model is whole."""


@dataclass(frozen=True)
class KnownView:
    """A photograph whose camera is known."""

    name: str
    """Of the file, relative to the folder of the photographs."""
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: np.ndarray
    """[3,4] rotation and translation, OpenCV axes (x right, y down, z forward)."""
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2 of OpenCV."""

    @property
    def camera(self) -> tuple[str, int, int, tuple[float, ...]]:
        """COLMAP's camera model, size in pixels, and parameters."""
        pinhole = (self.fx, self.fy, self.cx, self.cy)
        if any(self.distortion):
            return "OPENCV", self.width, self.height, (*pinhole, *self.distortion)
        return "PINHOLE", self.width, self.height, pinhole


def triangulate(
    images: Path, views: Sequence[KnownView], progress: Progress | None = None, tell: Tell = warnings.warn
) -> Path:
    """Triangulate points from photographs whose cameras are known; the cameras stay as they are. Kept and continued as
    `find_poses` does.

    Args:
        images: folder that the views' names are relative to.
        views: the photographs with their cameras.
        progress: told the stage and how far it is.
        tell: told where the points are kept, if not beside the photographs although these can be written.

    Returns:
        folder of a COLMAP model (cameras.bin, images.bin, points3D.bin) in the world of the given poses.

    Raises:
        CaptureError: too few points can be found; says what may be wrong.
        KeyboardInterrupt: Ctrl-C; what is done is kept.
    """
    images = Path(images)
    missing = [view.name for view in views if not (images / view.name).is_file()]
    if missing:
        raise CaptureError(
            f"{images / missing[0]} is missing ({len(missing)} of {len(views)}): put the photographs there"
        )
    if len(views) < 2:
        raise CaptureError(f"{images}: points need at least two photographs with poses, these are {len(views)}")
    check_names(images, [view.name for view in views])
    settings = [(view.name, view.camera, np.asarray(view.world_to_camera).tolist()) for view in views]
    key = content_key([(view.name, images / view.name) for view in views], settings)
    with work_folder(images, key, tell) as work:
        model = work / MODEL
        if (work / DONE).exists():
            return model
        with explained(work, CaptureError):
            process.run(_job(images, views, work), images, progress or no_progress)
            write_file(work / DONE, b"")
            shutil.rmtree(work / "links", ignore_errors=True)
            process.forget(work)
        return model


def _job(images: Path, views: Sequence[KnownView], work: Path) -> Job:
    links = work / "links"
    shutil.rmtree(links, ignore_errors=True)
    links.mkdir()
    groups: dict[tuple[str, int, int, tuple[float, ...]], list[str]] = defaultdict(list)
    names, poses = {}, {}
    for i, view in enumerate(views):
        plain = f"{i:06d}{Path(view.name).suffix.lower()}"
        (links / plain).symlink_to((images / view.name).resolve())
        groups[view.camera].append(plain)
        names[plain] = view.name
        poses[plain] = np.asarray(view.world_to_camera, float)[:3].tolist()
    return Job(
        work=str(work.resolve()),
        images=str(links.resolve()),
        masks=None,
        cameras=[CameraGroup(m, w, h, list(params), True, members) for (m, w, h, params), members in groups.items()],
        order=list(names),
        names=names,
        sequence=False,
        positions={},
        poses=poses,
    )
