"""Triangulate points from photographs with known poses."""

import os
import warnings
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from bitymi_ns.files import Tell
from bitymi_ns.progress import Progress, no_progress, rich_progress
from .cache import content_key, emptied, made_once, replace_stale
from .colmap_model import read_model
from .find_files import check_photographs_exist
from .image_files import from_header, image_size, read_image
from .masks import write_colmap_masks
from .points import Points
from .sfm import process
from .sfm.job import MODEL, CameraGroup, Job
from .sfm_photos import check_names, is_plain
from .types import OPENCV_AXES, CaptureError, ColmapCamera, Photograph, fail, say, warn

FEW_POINTS = 10  # per photograph
MIRROR = np.diag([1.0, 1.0, -1.0])


def triangulate(
    capture: Path, views: Sequence[Photograph], progress: Progress | None = None, tell: Tell = warnings.warn
) -> Path:
    """Triangulate points from photographs with known poses, and cameras in pixels of the files; return the folder of a
    COLMAP model in the world of the poses, kept beside the capture, with names relative to `capture`.
    Raises CaptureError: there are too few points."""
    check_photographs_exist(capture, [view.file for view in views])
    if len(views) < 2:
        fail(f"{capture}: points need at least two photographs with poses, these are {len(views)}")
    names = [os.path.relpath(view.file, capture) for view in views]
    check_names(capture, names)
    masks = [view.mask for view in views if view.mask is not None and os.path.isfile(view.mask)]
    inputs = [(os.path.relpath(file, capture), file) for file in (*(view.file for view in views), *masks)]
    poses = [np.linalg.inv(view.pose @ OPENCV_AXES)[:3].tolist() for view in views]  # world to camera
    key = content_key(inputs, [(view.camera, pose) for view, pose in zip(views, poses, strict=True)])
    folder = Path(os.path.commonpath([os.path.abspath(view.file.parent) for view in views]))

    def make(work: Path) -> None:
        process.run(_job(names, views, poses, work), capture, progress or no_progress)
        process.delete_work(work, "links", "masks")
        replace_stale(work, folder, content_key(inputs, "contents"))

    return made_once(capture, key, "points", tell, make) / MODEL


def triangulated(photographs: Sequence[Photograph], folder: Path, source: str) -> Points | None:
    """Triangulate points; None (with a warning) if that fails."""
    middle = np.mean([photograph.pose[:3, 3] for photograph in photographs], axis=0)
    mirrored = [bool(np.linalg.det(photograph.pose[:3, :3]) < 0.0) for photograph in photographs]
    mirror = MIRROR if all(mirrored) else np.eye(3)  # the photographs are not mirrored
    views = []
    for view in photographs:
        stored = (view.downscaled and image_size(view.file)) or view.camera.size
        pose = view.pose.copy()
        pose[:3] = mirror @ (pose[:3] - np.pad(middle[:, None], ((0, 0), (3, 0))))
        views.append(replace(view, camera=view.camera.rescaled(*stored), pose=pose))
    without = "`bitymi-data --points random`"
    say(f"{source} has no points: they are triangulated, once. {without} does without.")
    try:
        if any(mirrored) and not all(mirrored):
            fail("some poses are mirrored against the others")
        with rich_progress() as progress:
            model = read_model(triangulate(folder, views, progress, warn))
    except CaptureError as error:
        warn(f"No points can be triangulated: {error}. Training starts from random points.")
        return None
    say(f"{len(model.xyz):,} points have been triangulated, and are kept.")
    if len(model.xyz) < FEW_POINTS * len(views):
        warn(f"That is few for {len(views)} photographs, which share little detail: {without} may do better.")
    return Points(model.xyz @ mirror + middle, model.rgb)


def _job(stated: Sequence[str], views: Sequence[Photograph], poses: list[list[list[float]]], work: Path) -> Job:
    links, masks, names = emptied(work / "links"), {}, {}
    groups: dict[ColmapCamera, list[str]] = defaultdict(list)
    for i, (name, view) in enumerate(zip(stated, views, strict=True)):
        if from_header(view.file, lambda image, file=view.file: is_plain(image, file), False):
            plain = f"{i:06d}{view.file.suffix.lower()}"
            (links / plain).symlink_to(view.file.resolve())
        else:
            plain = f"{i:06d}.png"
            read_image(view.file).convert("RGB").save(links / plain)
        groups[view.camera].append(plain)
        names[plain] = name
        if view.mask is not None and os.path.isfile(view.mask):
            masks[plain] = view.mask, view.camera.size
    cameras = [CameraGroup(camera, True, members) for camera, members in groups.items()]
    folders = str(work.resolve()), str(links.resolve()), write_colmap_masks(work / "masks", masks)
    return Job(*folders, cameras, list(names), names, poses=dict(zip(names, poses, strict=True)))
