"""Poses of photographs and videos that have none yet."""

from __future__ import annotations

import os
from dataclasses import asdict, replace
from pathlib import Path

from bitymi_ns.capture.cache import read_from
from bitymi_ns.capture.photos import photo_folder
from bitymi_ns.capture.recognise import Found, passed_over
from bitymi_ns.capture.types import SfmSettings
from bitymi_ns.plugin.console import fail, listed, say, warn
from bitymi_ns.plugin.data import kept_poses
from bitymi_ns.plugin.data.colmap_model import read_model
from bitymi_ns.plugin.data.colmap_views import Origin, Source, masks_of_capture, source_in
from bitymi_ns.plugin.data.kept_poses import KeptPoses


def source_of(found: Found, masks_path: Path | None, reduction: int, settings: SfmSettings) -> Source:
    """The COLMAP model of a folder of photographs or of a video, found now or by an earlier run.

    Args:
        found: photographs, or a video.
        masks_path: folder of masks, seen from the capture; None = it is found.
        reduction: train on photographs that are so many times smaller.
        settings: how the poses are found.

    Raises:
        InputError: no poses can be found; says what to photograph differently.
    """
    from bitymi_ns.capture import CaptureError, SfmOptions, find_poses  # late: it is much, and seldom needed
    from bitymi_ns.progress import rich_progress

    masks = _masks(found, masks_path)
    others = passed_over(found.path) if found.format == "photographs" else []
    if others:
        say(f"Not taken for photographs in {found.path}: {listed(others)}.")
    try:
        with rich_progress() as progress:
            poses = find_poses(found.path, SfmOptions(**asdict(settings), masks=masks), progress, warn)
        read_from(poses.report.parent)
    except CaptureError as error:
        fail(str(error), error)
    say(
        f"Poses of {poses.registered} of {poses.given} photographs of {found.path}, to {poses.reprojection_error:.2f} "
        f"pixels; how they were found is in {poses.report}."
    )
    masks = _masks(found, masks_path, reduction)
    source = source_in(poses.model, poses.images, masks, reduction, poses.left_out)
    made = poses.images.is_relative_to(poses.report.parent)  # upright copies and frames lie in the folder of the work
    photographs = None if made else os.path.relpath(poses.images, found.folder)
    assert found.format in ("photographs", "video")
    origin = Origin(found.format, os.path.relpath(found.path, found.folder), photographs, settings)
    return replace(source, report=poses.report, origin=origin)


def source_of_run(found: Found, kept: KeptPoses, masks_path: Path | None, reduction: int, look: bool) -> Source:
    """The COLMAP model that a run was trained with, which nothing that happened to the photographs since changes.

    Args:
        found: photographs, or a video; see `KeptPoses.found`.
        kept: the poses of the run.
        masks_path, reduction: see `source_of`.
        look: the photographs are needed; else they may be missing.

    Raises:
        InputError: photographs of the model are missing, or have another size than they had.
    """
    images = kept.images(found.folder)
    masks = _masks(found, masks_path, reduction)
    source = source_in(kept.model, images, masks, reduction, kept.left_out)
    if look:
        kept_poses.check(source, kept.folder)
    count = len(read_model(source.folder).images)
    say(f"Poses of {count} photographs of {found.path} as the run was trained with them, of {kept.folder}.")
    return replace(source, report=kept.folder, origin=kept.origin)


def _masks(found: Found, given: Path | None, reduction: int = 1) -> Path | None:
    """The folder of the masks, which upright copies of the photographs share; a video has none."""
    if found.format == "video":
        return None
    return masks_of_capture(photo_folder(found.path), found.folder, given, reduction)
