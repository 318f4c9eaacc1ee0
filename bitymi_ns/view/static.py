"""A page with its bundle as a folder, which any web server can send."""

from __future__ import annotations

from pathlib import Path

from bitymi_ns.bundle.manifest import MANIFEST
from bitymi_ns.bundle.parts import files_of
from bitymi_ns.files import complete_folder
from bitymi_ns.trust import Refused, keep

from .page import BUNDLE, SINGLE, PageError, Site, page_files


def write_static(site: Site, folder: Path, overwrite: bool = False) -> int:
    """Writes what is served to a folder, which appears complete or not at all.

    Args:
        site: the page and its bundle.
        folder: where to.
        overwrite: replace a page that was written there before.

    Returns:
        bytes written.

    Raises:
        PageError: something else is there, or beside an earlier page.
        BundleError: a file of the bundle is missing, altered, or a link that leads out of it.
        OSError: the folder cannot be written.
    """

    def check() -> None:
        if not folder.exists() or (folder.is_dir() and not any(folder.iterdir())):
            return
        bundles = (folder / "bundle" / "bundle.json", folder / SINGLE)
        ours = (folder / "index.html").is_file() and any(bundle.is_file() for bundle in bundles)
        if not ours:
            raise PageError(f"{folder} holds something else than an exported page: choose another folder")
        if not overwrite:
            raise PageError(f"{folder} is there already: choose another folder, or add --overwrite")
        made = {*site.paths, *page_files(), "view.json", SINGLE}
        if (folder / BUNDLE / MANIFEST).is_file():
            made |= {f"{BUNDLE}{name}" for name in files_of(folder / BUNDLE)}
        try:
            keep(folder, made)
        except Refused as error:
            raise PageError(str(error)) from error

    with complete_folder(folder, check) as new:
        for path in site.paths:
            to = new / path
            to.parent.mkdir(exist_ok=True)
            to.write_bytes(site.read(path))
        return sum(path.stat().st_size for path in new.rglob("*") if path.is_file())
