"""Where a bundle may be written."""

from __future__ import annotations

import os
from pathlib import Path

from bitymi_ns.bundle.manifest import MANIFEST, BundleError


def check_target(folder: str | Path, overwrite: bool = False) -> None:
    """Checks that a bundle may take this place, before the work of making one.

    Raises:
        BundleError: it exists and `overwrite` is off, or it is something other than a bundle.
    """
    folder = Path(folder)
    if not os.path.lexists(folder):
        return
    if not folder.is_dir():
        what = "a link to nothing" if folder.is_symlink() and not folder.exists() else "not a folder"
        raise BundleError(f"{folder} is {what}; choose another place")
    if not any(folder.iterdir()):
        return
    if not (folder / MANIFEST).is_file():
        raise BundleError(
            f"{folder} is not a bundle (it has no {MANIFEST}) and is not overwritten; choose another place"
        )
    if not overwrite:
        raise BundleError(f"{folder} is a bundle already; choose another place, or replace it (--overwrite True)")
