"""Files that the viewer serves: the built page and the files of a bundle; and their export as a folder."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from importlib import resources
from pathlib import Path

from bitymi_ns.bundle.manifest import MANIFEST, BundleError, Manifest
from bitymi_ns.bundle.notes import notes_of
from bitymi_ns.bundle.parts import MANIFEST_LIMIT, NOTES, MissingPart, files_of, is_known, left_out, parts_of, passed_on
from bitymi_ns.bundle.read import manifest_of, read_file, read_manifest
from bitymi_ns.bundle.single import joined
from bitymi_ns.files import complete_folder
from bitymi_ns.trust import Refused, keep

TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".json": "application/json",
    ".ktx2": "image/ktx2",
    ".ply": "application/octet-stream",
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".webp": "image/webp",
}
_POLICY = re.compile(rb'http-equiv="Content-Security-Policy"\s+content="([^"]+)"')
NOTHING = "default-src 'none'"  # policy of a site without a page
BUNDLE = "bundle/"
_NOTES = f"{BUNDLE}{NOTES}"
SINGLE = "scene.bitymi"  # name of the one file beside an exported page
_ASKS = '<meta name="bundle" content="{}" />'
"""Tag that names the bundle file of the page; empty = the folder beside it."""


class PageError(ValueError):
    """The page cannot be shown; the message says what to do."""


@dataclass(frozen=True)
class Site:
    """Files served."""

    # path on the server, without the first slash, to what gives the contents
    files: Mapping[str, Callable[[], bytes | bytearray]]
    left_out: Sequence[str] = ()  # files that the bundle lists, and that are not served
    notes: Callable[[], bytes | None] = lambda: None  # the bundle's notes.json, which comes and goes; None without
    bundle: Shown | None = None  # whose files are served, as it is then

    def __contains__(self, path: str) -> bool:
        return path in self.files or path == _NOTES or path in self._parts

    @property
    def _parts(self) -> list[str]:
        """Paths of the files of the bundle."""
        return [] if self.bundle is None else [f"{BUNDLE}{name}" for name in self.bundle.names]

    @property
    def paths(self) -> list[str]:
        return sorted({*self.files, *self._parts, *([] if self.notes() is None else [_NOTES])})

    @cached_property
    def policy(self) -> str:
        """Content-Security-Policy of what is served: that of the page, and no frames. Nothing of a bundle runs: scripts
        come from the page alone, and a bundle's files are never sent as such."""
        found = _POLICY.search(self.files["index.html"]()) if "index.html" in self.files else None
        return f"{found[1].decode() if found else NOTHING}; frame-ancestors 'none'"

    def stamp(self, path: str) -> object:
        """A value that changes when what is served changes; that of notes is always another one."""
        return object() if path == _NOTES else None if self.bundle is None else self.bundle.stamp()

    def read(self, path: str) -> bytes | bytearray:
        """The contents of one of `paths`.

        Raises:
            BundleError: a file of the bundle is missing, altered, or a link that leads out of it.
            OSError: a file of the page cannot be read.
        """
        if path == _NOTES:
            notes = self.notes()
            if notes is None:
                raise MissingPart(f"the bundle has no {NOTES}")
            return notes
        if path in self.files or self.bundle is None:
            return self.files[path]()
        return self.bundle.read(path.removeprefix(BUNDLE))


def media_type(path: str) -> str:
    """Media type by the extension of a name; unknown ones are bytes."""
    return TYPES.get(Path(path).suffix.lower(), "application/octet-stream")


def page_files() -> dict[str, Callable[[], bytes | bytearray]]:
    """Readers of the files of the built page, by name.

    Raises:
        PageError: it was not built.
    """
    folder = Path(str(resources.files("bitymi_ns.view"))) / "page"
    files = {path.name: path.read_bytes for path in sorted(folder.glob("*")) if path.is_file()}
    if "index.html" not in files:
        raise PageError(f"the viewer's page is missing from {folder}: in a checkout, build it with `make web`")
    return files


def site_of(bundle: Path) -> Site:
    """The page with a bundle, a folder or one file; of the latter the parts are sent as files are.

    Raises:
        PageError: the page was not built.
        BundleError: there is no bundle, or its bundle.json or notes.json is damaged.
    """
    notes_of(bundle)
    shown = Shown(Path(os.path.realpath(bundle)))
    files = {**page_files(), "view.json": partial(_about, bundle)}
    return Site(files, left_out(shown.info), partial(notes_of, bundle), shown)


def single_site(bundle: Path) -> Site:
    """The page with a bundle as one file, of which it asks for ranges; of a server that knows none for the whole.

    Raises:
        PageError: the page was not built.
        BundleError: there is no bundle, or it is damaged.
    """
    info, files = read_manifest(bundle), page_files()
    empty, named = (_ASKS.format(name).encode() for name in ("", SINGLE))
    index = files["index.html"]()
    if empty not in index:
        raise PageError("the viewer's page is of another version: in a checkout, build it with `make web`")
    files["index.html"] = lambda: index.replace(empty, named)
    files |= {SINGLE: lambda: joined(bundle)[0], "view.json": partial(_about, bundle)}
    return Site(files, left_out(info))


def _about(bundle: Path) -> bytes:
    """Contents of view.json: the title of a bundle, and whether it has notes."""
    try:
        notes = notes_of(bundle) is not None
    except BundleError:  # damaged since: the page asks for it, and states that it cannot be read
        notes = True
    path = Path(os.path.realpath(bundle))
    title = path.stem if os.path.isfile(path) else path.parent.name if path.name == "bundle" else path.name
    return json.dumps({"title": title, "notes": notes}).encode()


class Shown:
    """A bundle that is being served. Its files have the sizes and hashes of its bundle.json whenever they are read; a
    bundle that is exported again meanwhile is served as it is then."""

    def __init__(self, bundle: Path) -> None:
        self._bundle = bundle
        self._read_manifest()

    def _read_manifest(self) -> None:
        as_of = self.stamp()
        with parts_of(self._bundle, inside=True) as parts:
            self.info: Manifest = manifest_of(parts)
            self._manifest = passed_on(self.info, parts.read(MANIFEST, MANIFEST_LIMIT))
        self._as_of = as_of

    @property
    def names(self) -> list[str]:
        """Names of the files that are passed on now; those of before where bundle.json cannot be read."""
        with suppress(BundleError):
            self._refresh()
        return [MANIFEST, *(name for name in self.info.files if is_known(name))]

    def _refresh(self) -> None:
        if self.stamp() != self._as_of:
            self._read_manifest()

    def stamp(self) -> tuple[int, ...]:
        """A value that changes when bundle.json, or the one file, is written."""
        path = self._bundle if os.path.isfile(self._bundle) else self._bundle / MANIFEST
        try:
            found = os.stat(path)
        except OSError:  # reported when it is read
            return ()
        return found.st_ino, found.st_size, found.st_mtime_ns

    def read(self, name: str) -> bytes | bytearray:
        """A file as it is passed on.

        Raises:
            BundleError: it is missing, altered, or a link that leads out of the bundle.
        """
        self._refresh()
        if name == MANIFEST:
            return self._manifest
        if name not in self.info.files:
            raise BundleError(f"{self._bundle} has no {name} any longer")
        with parts_of(self._bundle, inside=True) as parts:
            return read_file(parts, self.info, name)


def write_static(site: Site, folder: Path, overwrite: bool = False) -> int:
    """Write the files that are served to a folder, which appears complete or not at all.

    Args:
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
            raise PageError(f"{folder} holds something other than an exported page: choose another folder")
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
