"""Poses of photographs and videos that have none yet, found while somebody watches."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from nerfstudio.utils.rich_utils import CONSOLE
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

from bitymi_ns.host.colmap_views import Source, find_source
from bitymi_ns.host.errors import fail, say
from bitymi_ns.recognise import Found

if TYPE_CHECKING:
    from bitymi_ns.capture import Progress as Watch


def source_of(found: Found, masks_path: Path | None, reduction: int) -> Source:
    """The COLMAP model of a folder of photographs or of a video, found now or by an earlier run.

    Args:
        found: photographs, or a video.
        masks_path: folder of masks, seen from the capture; None = `masks` beside the photographs, if there is one.
        reduction: train on photographs that are so many times smaller.

    Raises:
        InputError: no poses can be found; says what to photograph differently.
    """
    from bitymi_ns.capture import CaptureError, SfmOptions, find_poses  # late: it is much, and seldom needed

    masks = None if masks_path is None else found.folder / masks_path
    try:
        with _stages() as watch:
            poses = find_poses(found.path, SfmOptions(masks=masks), watch)
    except CaptureError as error:
        fail(str(error), error)
    say(
        f"Poses of {poses.registered} of {poses.given} photographs of {found.path}, to {poses.reprojection_error:.2f} "
        f"pixels; how they were found is in {poses.report}."
    )
    if masks is None and found.format == "photographs" and (found.path / "masks").is_dir():
        masks = found.path / "masks"
    return find_source(poses.model, poses.images, Path(), masks, reduction, poses.left_out, look=False)


@contextmanager
def _stages() -> Iterator[Watch]:
    """A bar per stage on a terminal; elsewhere a line per stage."""
    columns = (TextColumn("{task.description}"), MofNCompleteColumn(), BarColumn(), TimeElapsedColumn())
    with Progress(*columns, console=CONSOLE, transient=True, disable=not CONSOLE.is_terminal) as bar:
        tasks: dict[str, int] = {}

        def watch(step: str, done: int, total: int) -> None:
            if step not in tasks:
                tasks[step] = bar.add_task(step[:1].upper() + step[1:])
                if not CONSOLE.is_terminal:
                    say(f"Finding poses: {step}")
            bar.update(tasks[step], completed=done, total=total)  # type: ignore[arg-type]

        yield watch
