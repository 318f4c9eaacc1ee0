"""Finding the camera poses of photographs or of a video."""

from __future__ import annotations

from pathlib import Path

from bitymi_ns.capture.types import Poses, Progress, SfmOptions


def find_poses(source: Path, options: SfmOptions | None = None, progress: Progress | None = None) -> Poses:
    """Find the camera poses of photographs or of the frames of a video, once: the result is kept beside them, or in the
    user's cache folder where nothing can be written there, and a run that was ended goes on where it stopped.

    Args:
        source: a folder of photographs, a folder that holds them in `images` (and masks in `masks`), or a video.
        options: how; None = the defaults.
        progress: told the stage and how far it is.

    Raises:
        CaptureError: no poses can be found; says what to photograph differently.
        KeyboardInterrupt: Ctrl-C; what is done is kept.
    """
    raise NotImplementedError
