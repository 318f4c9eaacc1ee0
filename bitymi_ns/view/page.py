"""Files served by the viewer (the built page and a bundle), and their export to a folder."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from importlib import resources
from pathlib import Path

from bitymi_ns.bundle.manifest import MANIFEST, BundleError, Manifest
from bitymi_ns.bundle.notes import notes_of
from bitymi_ns.bundle.parts import (
    MANIFEST_LIMIT,
    NOTES,
    MissingPart,
    files_of,
    is_known,
    left_out,
    parts_of,
    public_manifest,
)
from bitymi_ns.bundle.read import manifest_of, read_file, read_manifest
from bitymi_ns.bundle.single import joined
from bitymi_ns.files import complete_folder
from bitymi_ns.trust import check_replaceable

TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".json": "application/json",
    ".ktx2": "image/ktx2",
    ".png": "image/png",
    ".jpg": "image/jpeg",
    ".webp": "image/webp",
}
_POLICY = re.compile(rb'http-equiv="Content-Security-Policy"\s+content="([^"]+)"')
NOTHING = "default-src 'none'"  # Content-Security-Policy of a site without a page
BUNDLE = "bundle/"
_NOTES = f"{BUNDLE}{NOTES}"
SINGLE = "scene.bitymi"  # name of a single-file bundle beside an exported page
_BUNDLE_TAG = '<meta name="bundle" content="{}" />'
"""Names the page's single-file bundle; empty: the bundle folder beside the page."""


class PageError(ValueError):
    """The page cannot be shown; the message says what to do."""


@dataclass(frozen=True)
class Site:
    files: Mapping[str, Callable[[], bytes | bytearray]]  # path without leading slash -> reader of the contents
    left_out: Sequence[str] = ()  # files listed in the bundle but not served
    notes: Callable[[], bytes | None] = lambda: None  # reads the bundle's current notes.json; None: there is none
    bundle: Shown | None = None  # bundle to serve, in its current state

    def __contains__(self, path: str) -> bool:
        return path in self.files or path == _NOTES or path in self._parts

    @property
    def _parts(self) -> list[str]:
        return [] if self.bundle is None else [f"{BUNDLE}{name}" for name in self.bundle.names]

    @property
    def paths(self) -> list[str]:
        return sorted({*self.files, *self._parts, *([] if self.notes() is None else [_NOTES])})

    @cached_property
    def policy(self) -> str:
        """Content-Security-Policy of all responses: that of the page, without frames. Nothing in a bundle can run, as
        its files are never sent as scripts."""
        found = _POLICY.search(self.files["index.html"]()) if "index.html" in self.files else None
        return f"{found[1].decode() if found else NOTHING}; frame-ancestors 'none'"

    def stamp(self, path: str) -> object:
        """Return a value that changes when the contents of a path change; always a new one for notes."""
        return object() if path == _NOTES else None if self.bundle is None else self.bundle.stamp()

    def read(self, path: str) -> bytes | bytearray:
        """Read one of `paths`. Raises BundleError: as `Shown.read`."""
        if path == _NOTES:
            notes = self.notes()
            if notes is None:
                raise MissingPart(f"the bundle has no {NOTES}")
            return notes
        if path in self.files or self.bundle is None:
            return self.files[path]()
        return self.bundle.read(path.removeprefix(BUNDLE))


def media_type(path: str) -> str:
    return TYPES.get(Path(path).suffix.lower(), "application/octet-stream")


def page_files() -> dict[str, Callable[[], bytes | bytearray]]:
    """Return readers of the built page's files, by name. Raises PageError: the page was not built."""
    folder = Path(str(resources.files("bitymi_ns.view"))) / "page"
    paths = [path for path in sorted(folder.glob("*")) if path.is_file()]
    files: dict[str, Callable[[], bytes | bytearray]] = {path.name: path.read_bytes for path in paths}
    if "index.html" not in files:
        raise PageError(f"the viewer's page is missing from {folder}: in a checkout, build it with `make web`")
    return files


def site_of(bundle: Path) -> Site:
    """Build a site of the page and a bundle, whose parts are served as separate files. Raises PageError: the page was
    not built; BundleError: there is no bundle, or its bundle.json or notes.json is damaged."""
    notes_of(bundle)
    shown = Shown(Path(os.path.realpath(bundle)))
    files = {**page_files(), "view.json": partial(_view_json, bundle)}
    return Site(files, left_out(shown.info), partial(notes_of, bundle), shown)


def single_site(bundle: Path) -> Site:
    """Build a site of the page and a single-file bundle, which the page reads by range requests or as a whole. Raises
    as `site_of`."""
    info, files = read_manifest(bundle), page_files()
    empty, named = (_BUNDLE_TAG.format(name).encode() for name in ("", SINGLE))
    index = files["index.html"]()
    if empty not in index:
        raise PageError("the viewer's page is of another version: in a checkout, build it with `make web`")
    files["index.html"] = lambda: index.replace(empty, named)
    files |= {SINGLE: lambda: joined(bundle)[0], "view.json": partial(_view_json, bundle)}
    return Site(files, left_out(info))


def _view_json(bundle: Path) -> bytes:
    """Encode view.json: title of a bundle, and whether it has notes."""
    try:
        notes = notes_of(bundle) is not None
    except BundleError:  # damaged in the meantime: the page requests the notes and shows the error
        notes = True
    path = Path(os.path.realpath(bundle))
    title = path.stem if os.path.isfile(path) else path.parent.name if path.name == "bundle" else path.name
    return json.dumps({"title": title, "notes": notes}).encode()


class Shown:
    """A bundle being served: the current one if it is exported again. Each read checks size and hash of the file."""

    def __init__(self, bundle: Path) -> None:
        self._bundle = bundle
        self._read_manifest()

    def _read_manifest(self) -> None:
        as_of = self.stamp()
        with parts_of(self._bundle, inside=True) as parts:
            self.info: Manifest = manifest_of(parts)
            self._manifest = public_manifest(self.info, parts.read(MANIFEST, MANIFEST_LIMIT))
        self._as_of = as_of

    @property
    def names(self) -> list[str]:
        """Names of the served files; the earlier ones if bundle.json cannot be read."""
        with suppress(BundleError):
            self._refresh()
        return [MANIFEST, *(name for name in self.info.files if is_known(name))]

    def _refresh(self) -> None:
        if self.stamp() != self._as_of:
            self._read_manifest()

    def stamp(self) -> tuple[int, ...]:
        """Return a value that changes when bundle.json, or the single file, is written."""
        path = self._bundle if os.path.isfile(self._bundle) else self._bundle / MANIFEST
        try:
            status = os.stat(path)
        except OSError:  # reported when it is read
            return ()
        return status.st_ino, status.st_size, status.st_mtime_ns

    def read(self, name: str) -> bytes | bytearray:
        """Read a file to serve. Raises BundleError: it is missing, altered, or a link out of the bundle."""
        self._refresh()
        if name == MANIFEST:
            return self._manifest
        if name not in self.info.files:
            raise BundleError(f"{self._bundle} has no {name} any longer")
        with parts_of(self._bundle, inside=True) as parts:
            return read_file(parts, self.info, name)


def write_static(site: Site, folder: Path, overwrite: bool = False) -> int:
    """Write the files of a site to a folder, complete or not at all; return the bytes written. Raises PageError: the
    folder holds other files, or an exported page without `overwrite`. Raises BundleError: as `Shown.read`. Raises
    OSError: the folder cannot be written."""

    def check() -> None:
        has_folder = (folder / BUNDLE / MANIFEST).is_file()
        ours = (folder / "index.html").is_file() and (has_folder or (folder / SINGLE).is_file())
        check_replaceable(folder, "an exported page", made(has_folder) if ours else None, overwrite, PageError)

    def made(has_folder: bool) -> Iterator[str]:
        yield from {*site.paths, *page_files(), "view.json", SINGLE}
        yield from (f"{BUNDLE}{name}" for name in (files_of(folder / BUNDLE) if has_folder else ()))

    with complete_folder(folder, check) as new:
        for path in site.paths:
            to = new / path
            to.parent.mkdir(exist_ok=True)
            to.write_bytes(site.read(path))
        return sum(path.stat().st_size for path in new.rglob("*") if path.is_file())
