"""Folder of a training run: one process at a time trains into it."""

import atexit
import shutil
from pathlib import Path

from bitymi_ns import files, locks
from bitymi_ns.capture.colmap_views import Source
from bitymi_ns.capture.sfm_poses import write_kept_poses
from bitymi_ns.capture.sfm_report import FILES
from bitymi_ns.trust import check_no_links
from ..console import InputError, fail, warn

LOCK = ".lock"  # file of a training process
POSES = "poses"  # subfolder of found poses and their report


def take(folder: Path) -> None:
    """Make the folder, hold it until `leave` or the end of the process, and remove unfinished files of killed runs."""
    with files.write_errors_as(folder, InputError, " (--output-dir)."):
        folder.mkdir(parents=True, exist_ok=True)
        try:
            locks.hold(folder / LOCK, warn)
        except locks.Busy as error:
            other = "give another --timestamp, --experiment-name or --output-dir"
            fail(f"{folder} is in use: {error}. Or {other}.", error)
    atexit.register(leave, folder)
    files.remove_unfinished(folder)


def check_unused(folder: Path, checkpoints: Path) -> None:
    """Stop a new run whose checkpoints would mix with those of an earlier one."""
    there = sorted(checkpoints.glob("step-*.ckpt"))
    if there:
        fail(
            f"{folder} holds a run, up to {there[-1].name}. To go on with it give --load-dir {checkpoints}; for a new "
            "run give another --timestamp, --experiment-name or --output-dir."
        )


def leave(folder: Path) -> None:
    locks.release(folder / LOCK)


def keep_poses_report(folder: Path, report: Path | None, source: Source | None = None) -> None:
    """Copy found poses and their report to POSES, to outlast the photographs."""
    there = [] if report is None else [report / name for name in FILES if (report / name).is_file()]
    origin = None if source is None else source.origin
    if origin is None and not there:
        return
    if report is not None and report.resolve() == (folder / POSES).resolve():
        return
    try:
        check_no_links([folder / POSES])
        with files.complete_folder(folder / POSES, tell=warn) as new:
            for file in there:
                shutil.copyfile(file, new / file.name)
            if source is not None and origin is not None:
                write_kept_poses(new, source, origin)
    except OSError as error:
        loss = "" if origin is None else " Nor are the poses: leave the photographs as they are while you use the run."
        warn(f"The report on the poses is not kept with the run: {files.reason(error, folder)}.{loss}")


def check_space(folder: Path, needed: int) -> None:
    """Stop if there is no room for a checkpoint of `needed` bytes."""
    free = files.free_bytes(folder)
    if free < needed:
        fail(
            f"{folder} has {files.size_text(free)} free, and a checkpoint takes {files.size_text(needed)} or more: "
            "free some space, or give an --output-dir on another disk."
        )
