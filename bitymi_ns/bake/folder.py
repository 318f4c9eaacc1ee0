"""A folder that appears complete or not at all."""

from __future__ import annotations

import os
import shutil
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from bitymi_ns.bake.manifest import MANIFEST, BundleError


def check_target(folder: str | Path, overwrite: bool = False) -> None:
    """Checks that a bundle may be written to `folder`, before the work of making one.

    Raises:
        BundleError: it exists and `overwrite` is off, or it is something other than a bundle.
    """
    folder = Path(folder)
    if not os.path.lexists(folder):
        return
    if not folder.is_dir():
        raise BundleError(f"{folder} exists and is not a folder")
    if not any(folder.iterdir()):
        return
    if not overwrite:
        raise BundleError(f"{folder} exists; choose another folder, or overwrite it (overwrite=True)")
    if not (folder / MANIFEST).is_file():
        raise BundleError(f"{folder} is not a bundle (it has no {MANIFEST}); it is not overwritten")


@contextmanager
def complete_folder(folder: str | Path, overwrite: bool = False) -> Iterator[Path]:
    """A temporary folder beside the target that takes the target's place when the block ends without an exception.

    On any exception, KeyboardInterrupt included, the temporary folder is removed and the target is as it was.

    Args:
        folder: the target; its parents are made.
        overwrite: replace an existing bundle: it is moved aside, the new one takes its name, the old one is deleted.

    Yields:
        the temporary folder.
    """
    check_target(folder, overwrite)
    target = Path(folder).resolve()
    target.parent.mkdir(parents=True, exist_ok=True)
    tag = uuid.uuid4().hex[:8]
    temporary = target.with_name(f".{target.name}.new-{tag}")
    aside = target.with_name(f".{target.name}.old-{tag}")
    try:
        temporary.mkdir()
        yield temporary
        for path in temporary.iterdir():
            _flush(path)
        check_target(target, overwrite)
        if target.exists():
            target.rename(aside)
        temporary.rename(target)
    except BaseException:
        if aside.exists() and not target.exists():
            aside.rename(target)
        shutil.rmtree(temporary, ignore_errors=True)
        raise
    shutil.rmtree(aside, ignore_errors=True)


def _flush(path: Path) -> None:
    """Makes sure that the file's bytes are on the disk: a full disk is reported here at the latest."""
    with open(path, "rb") as file:
        os.fsync(file.fileno())
