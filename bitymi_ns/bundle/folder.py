"""Where a bundle may be written."""

from __future__ import annotations

import os
from pathlib import Path

from bitymi_ns.bundle.manifest import MANIFEST, BundleError
from bitymi_ns.bundle.parts import MANIFEST_LIMIT, parts_of
from bitymi_ns.trust import Refused, json_of, keep

CONFIG = "config.yml"
"""Configuration for nerfstudio's tools, for which bundle.json does not vouch."""


def check_target(folder: str | Path, overwrite: bool = False) -> None:
    """Checks that a bundle may take this place, before the work of making one.

    Raises:
        BundleError: it exists and `overwrite` is off; or it is something other than a bundle, or holds something else.
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
    try:
        keep(folder, files_of(folder))
    except Refused as error:
        raise BundleError(str(error)) from error


def files_of(folder: Path) -> list[str]:
    """Names of the files of a bundle, of whatever version it is: those that its bundle.json lists, that itself, and the
    configuration for nerfstudio's tools.

    Raises:
        BundleError: bundle.json cannot be read.
    """
    try:
        with parts_of(folder) as parts:
            listed = json_of(bytes(parts.read(MANIFEST, MANIFEST_LIMIT)))["files"]
        return [MANIFEST, CONFIG, *map(str, listed)]
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise BundleError(
            f"{folder / MANIFEST} cannot be read ({error}): it is not known what of {folder} is the bundle. Remove it "
            "yourself, or choose another place"
        ) from error
