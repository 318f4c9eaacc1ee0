"""A point cloud for photographs whose poses are known."""

from __future__ import annotations

import shutil
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from PIL import Image

from bitymi_ns.capture.cache import content_key, finished, work_folder
from bitymi_ns.capture.masks import counted
from bitymi_ns.capture.photos import PLAIN_SUFFIXES
from bitymi_ns.capture.sfm import process
from bitymi_ns.capture.sfm.job import MODEL, CameraGroup, Job
from bitymi_ns.capture.types import CaptureError
from bitymi_ns.files import explained, write_file
from bitymi_ns.progress import Progress, no_progress

DONE = "points"
"""File that is written when the model is whole."""


@dataclass(frozen=True)
class KnownView:
    """A photograph whose camera is known."""

    file: Path
    model: str
    """COLMAP's camera model."""
    width: int
    height: int
    params: tuple[float, ...]
    """Of the camera model, in pixels of the file."""
    world_to_camera: np.ndarray
    """[3,4] rotation and translation, OpenCV axes (x right, y down, z forward)."""
    mask: Path | None = None
    """Picture that is black where no point is to be found; see `masks.counted`."""

    @property
    def camera(self) -> tuple[str, int, int, tuple[float, ...]]:
        """What photographs of one camera have in common."""
        return self.model, self.width, self.height, self.params


def triangulate(home: Path, views: Sequence[KnownView], progress: Progress | None = None) -> Path:
    """Triangulate points from photographs whose cameras are known; the cameras stay as they are. Kept and continued as
    `find_poses` does.

    Args:
        home: folder of the capture, beside whose photographs the result is kept.
        views: the photographs with their cameras.
        progress: told the stage and how far it is.

    Returns:
        folder of a COLMAP model (cameras.bin, images.bin, points3D.bin) in the world of the given poses, in which the
        photographs have their full names.

    Raises:
        CaptureError: too few points can be found; says what may be wrong.
        KeyboardInterrupt: Ctrl-C; what is done is kept.
    """
    missing = [view.file for view in views if not view.file.is_file()]
    if missing:
        raise CaptureError(f"{missing[0]} is missing ({len(missing)} of {len(views)}): put the photographs there")
    if len(views) < 2:
        raise CaptureError(f"{home}: points need at least two photographs with poses, these are {len(views)}")
    settings = [(view.camera, np.asarray(view.world_to_camera).tolist()) for view in views]
    masks = [view.mask for view in views if view.mask is not None and view.mask.is_file()]
    key = content_key([*(view.file for view in views), *masks], settings)
    done = finished(home, key, DONE)
    if done is not None:  # several processes may read it
        return done / MODEL
    with work_folder(home, key) as work:
        with explained(work, CaptureError):
            process.run(_job(views, work), home, progress or no_progress)
            write_file(work / DONE, b"")
            for name in ("links", "masks"):
                shutil.rmtree(work / name, ignore_errors=True)
            process.forget(work)
        return work / MODEL


def _job(views: Sequence[KnownView], work: Path) -> Job:
    links = work / "links"
    shutil.rmtree(links, ignore_errors=True)
    links.mkdir()
    groups: dict[tuple[str, int, int, tuple[float, ...]], list[str]] = defaultdict(list)
    names, poses = {}, {}
    for i, view in enumerate(views):
        suffix = view.file.suffix.lower()
        plain = f"{i:06d}{suffix if suffix in PLAIN_SUFFIXES else '.png'}"
        if suffix in PLAIN_SUFFIXES:
            (links / plain).symlink_to(view.file.resolve())
        else:
            with Image.open(view.file) as image:
                image.convert("RGB").save(links / plain)
        groups[view.camera].append(plain)
        names[plain] = str(view.file)
        poses[plain] = np.asarray(view.world_to_camera, float)[:3].tolist()
        if view.mask is not None and view.mask.is_file():
            with Image.open(view.mask) as image:
                mask = Image.fromarray(counted(image))
            (work / "masks").mkdir(exist_ok=True)
            size = (view.width, view.height)
            mask.resize(size, Image.Resampling.NEAREST).convert("L").save(work / "masks" / f"{plain}.png")
    return Job(
        work=str(work.resolve()),
        images=str(links.resolve()),
        masks=str((work / "masks").resolve()) if (work / "masks").is_dir() else None,
        cameras=[CameraGroup(m, w, h, list(params), True, members) for (m, w, h, params), members in groups.items()],
        order=list(names),
        names=names,
        sequence=False,
        positions={},
        poses=poses,
    )
