"""Poses of photographs and videos that have none yet."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path

from bitymi_ns.capture.cache import read_from
from bitymi_ns.capture.recognise import Found
from bitymi_ns.capture.types import SfmSettings
from bitymi_ns.host.colmap_views import Source, find_source
from bitymi_ns.host.errors import fail, say


def source_of(found: Found, masks_path: Path | None, reduction: int, settings: SfmSettings) -> Source:
    """The COLMAP model of a folder of photographs or of a video, found now or by an earlier run.

    Args:
        found: photographs, or a video.
        masks_path: folder of masks, seen from the capture; None = `masks` beside the photographs, if there is one.
        reduction: train on photographs that are so many times smaller.
        settings: how the poses are found.

    Raises:
        InputError: no poses can be found; says what to photograph differently.
    """
    from bitymi_ns.capture import CaptureError, SfmOptions, find_poses  # late: it is much, and seldom needed
    from bitymi_ns.progress import rich_progress

    masks = None if masks_path is None else found.folder / masks_path
    try:
        with rich_progress() as progress:
            poses = find_poses(found.path, SfmOptions(**asdict(settings), masks=masks), progress)
        read_from(poses.report.parent)
    except CaptureError as error:
        fail(str(error), error)
    say(
        f"Poses of {poses.registered} of {poses.given} photographs of {found.path}, to {poses.reprojection_error:.2f} "
        f"pixels; how they were found is in {poses.report}."
    )
    if masks is None and found.format == "photographs" and (found.path / "masks").is_dir():
        masks = found.path / "masks"
    source = find_source(poses.model, poses.images, Path(), masks, reduction, poses.left_out, look=False)
    return replace(source, report=poses.report)
