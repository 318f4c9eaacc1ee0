"""The folder of a training run: one process at a time trains into it, and it keeps how the poses were found."""

import atexit
import shutil
from pathlib import Path

from bitymi_ns import files
from bitymi_ns.capture.colmap_views import Source
from bitymi_ns.capture.report import FILES
from bitymi_ns.capture.sfm_poses import write_kept_poses
from bitymi_ns.plugin.console import InputError, fail, warn
from bitymi_ns.trust import check_no_links

LOCK = ".lock"  # name of the file that lies in a run folder while a process trains into it
POSES = "poses"
"""Folder in that of the run for the poses and the report on how they were found, where this package found them."""


def take(folder: Path) -> None:
    """Make the folder where it is missing and hold it until `leave` or the end of the process; remove what killed runs
    left unfinished there.

    Raises:
        InputError: another process trains into it, or it cannot be written.
    """
    with files.explained(folder, InputError, " (--output-dir)."):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            files.hold(folder / LOCK, warn)
        except files.Busy as error:
            other = "give another --timestamp, --experiment-name or --output-dir"
            fail(f"{folder} is in use: {error}. Or train into another folder: {other}.", error)
    atexit.register(leave, folder)
    files.remove_unfinished(folder)


def check_unused(folder: Path, checkpoints: Path) -> None:
    """Stop where a new run would mix with, and in time replace, the checkpoints of an earlier one."""
    there = sorted(checkpoints.glob("step-*.ckpt"))
    if there:
        fail(
            f"{folder} holds a run already, its newest checkpoint is {there[-1].name}. To go on with it give "
            f"--load-dir {checkpoints}; for a new run give another --timestamp, --experiment-name or --output-dir."
        )


def leave(folder: Path) -> None:
    """Let other processes train into the folder."""
    files.release(folder / LOCK)


def keep_poses_report(folder: Path, report: Path | None, source: Source | None = None) -> None:
    """Copy the poses that were found, and the report on how, to POSES, so that they stay when the photographs change.

    Args:
        report: folder of the report; None = the capture came with its poses.
        source: the poses that were found; None = the capture came with them.
    """
    there = [] if report is None else [report / name for name in FILES if (report / name).is_file()]
    origin = None if source is None else source.origin
    if origin is None and not there:
        return
    if report is not None and report.resolve() == (folder / POSES).resolve():
        return  # the run goes on with what it keeps already
    try:
        check_no_links([folder / POSES])
        with files.complete_folder(folder / POSES, tell=warn) as new:
            for file in there:
                shutil.copyfile(file, new / file.name)
            if source is not None and origin is not None:
                write_kept_poses(new, source, origin)
    except OSError as error:
        loss = "" if origin is None else " Nor are the poses: leave the photographs as they are while you use the run."
        warn(f"How the poses were found is not kept with the run: {files.reason(error, folder)}.{loss}")


def check_space(folder: Path, needed: int) -> None:
    """Stop before the first step when there is no room for a single checkpoint.

    Args:
        needed: bytes of a checkpoint of the scene as it is now.
    """
    free = files.free_bytes(folder)
    if free < needed:
        fail(
            f"{folder} has {files.size_text(free)} free, and a checkpoint takes {files.size_text(needed)} already at "
            "the start: free some space, or give an --output-dir on another disk."
        )
