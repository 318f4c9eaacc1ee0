"""What a browser may ask for: the built page, and the files of a bundle that its bundle.json lists; nothing else."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from importlib import resources
from pathlib import Path

from bitymi_ns.bundle import archive
from bitymi_ns.bundle.manifest import MANIFEST, BundleError, Manifest
from bitymi_ns.bundle.read import MANIFEST_LIMIT, read_manifest
from bitymi_ns.bundle.single import single_bytes

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
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Nothing of a bundle runs: scripts come from the page alone, and a bundle's files are never sent as such."""
BUNDLE = "bundle/"
SINGLE = "scene.bitymi"
"""Name of the one file beside an exported page."""
_ASKS = '<meta name="bundle" content="{}" />'
"""Where the page reads which file it shows; empty = the folder beside it."""


class PageError(ValueError):
    """The page cannot be shown; the message says what to do."""


@dataclass(frozen=True)
class Site:
    """What is served.

    Attributes:
        files: path on the server, without the first slash, to the file.
        made: the same for what does not lie in a file of its own: to what gives its contents.
    """

    files: Mapping[str, Path]
    made: Mapping[str, Callable[[], bytes]]

    @property
    def paths(self) -> list[str]:
        return sorted({*self.files, *self.made})

    def read(self, path: str) -> bytes:
        """The contents of one of `paths`.

        Raises:
            OSError: it cannot be read, or no longer.
        """
        return self.made[path]() if path in self.made else self.files[path].read_bytes()


def media_type(path: str) -> str:
    """By the ending of a name; what is not known is never guessed."""
    return TYPES.get(Path(path).suffix.lower(), "application/octet-stream")


def page_files() -> dict[str, Path]:
    """The built page, by name.

    Raises:
        PageError: it was not built.
    """
    folder = Path(str(resources.files("bitymi_ns.view"))) / "page"
    files = {path.name: path for path in sorted(folder.glob("*")) if path.is_file()}
    if "index.html" not in files:
        raise PageError(f"the viewer's page is missing from {folder}: in a checkout, build it with `make web`")
    return files


def site_of(bundle: Path) -> Site:
    """The page with a bundle, a folder or one file; of the latter the parts are sent as files are.

    Raises:
        PageError: the page was not built, or a file of the bundle lies elsewhere.
        BundleError: there is no bundle, or its bundle.json is damaged.
    """
    info = read_manifest(bundle)
    place = bundle.resolve()
    files, made = dict(page_files()), {}
    # a page or a script has no place in a bundle
    names = [name for name in (MANIFEST, *info.files) if not media_type(name).startswith("text/")]
    for name in names:
        path = place / name
        if place.is_file():
            made[f"{BUNDLE}{name}"] = partial(_part, place, info, name)
        elif path.resolve().parent != place:
            raise PageError(f"{path} is a link that leads out of the bundle: it is not shown")
        else:
            files[f"{BUNDLE}{name}"] = path
    return Site(files, {**made, "view.json": _title(place)})


def single_site(bundle: Path) -> Site:
    """The page with a bundle as one file, of which it asks for ranges; of a server that knows none for the whole.

    Raises:
        PageError: the page was not built.
        BundleError: there is no bundle, or it is damaged.
    """
    read_manifest(bundle)
    place, files = bundle.resolve(), dict(page_files())
    empty, named = (_ASKS.format(name).encode() for name in ("", SINGLE))
    index = files.pop("index.html").read_bytes()
    if empty not in index:
        raise PageError("the viewer's page is of another version: in a checkout, build it with `make web`")
    made: dict[str, Callable[[], bytes]] = {"index.html": lambda: index.replace(empty, named)}
    if place.is_file():
        files[SINGLE] = place
    else:
        made[SINGLE] = partial(single_bytes, place)
    return Site(files, {**made, "view.json": _title(place)})


def _title(place: Path) -> Callable[[], bytes]:
    """What view.json says of a bundle."""
    title = place.stem if place.is_file() else place.parent.name if place.name == "bundle" else place.name
    text = json.dumps({"title": title}).encode()
    return lambda: text


def _part(file: Path, info: Manifest, name: str) -> bytes:
    """A part of a bundle in one file.

    Raises:
        OSError: the file is no longer what it was.
    """
    try:
        with archive.opened(file, str(file)) as parts:
            return parts.part(name, MANIFEST_LIMIT if name == MANIFEST else info.files[name].bytes)
    except BundleError as error:
        raise OSError(str(error)) from error
