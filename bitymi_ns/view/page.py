"""What a browser may ask for: the built page, and the files of a bundle that its bundle.json lists; nothing else."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from importlib import resources
from pathlib import Path

from bitymi_ns.bundle.manifest import MANIFEST
from bitymi_ns.bundle.read import read_manifest

TYPES = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".json": "application/json",
    ".ktx2": "image/ktx2",
    ".ply": "application/octet-stream",
    ".png": "image/png",
    ".jpg": "image/jpeg",
}
POLICY = (
    "default-src 'none'; script-src 'self'; style-src 'self'; img-src 'self' blob: data:; connect-src 'self'; "
    "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
)
"""Nothing of a bundle runs: scripts come from the page alone, and a bundle's files are never sent as such."""
BUNDLE = "bundle/"


class PageError(ValueError):
    """The page cannot be shown; the message says what to do."""


@dataclass(frozen=True)
class Site:
    """What is served.

    Attributes:
        files: path on the server, without the first slash, to the file.
        texts: the same for what is made here.
    """

    files: Mapping[str, Path]
    texts: Mapping[str, bytes]

    @property
    def paths(self) -> list[str]:
        return sorted({*self.files, *self.texts})

    def read(self, path: str) -> bytes:
        """The contents of one of `paths`."""
        return self.texts[path] if path in self.texts else self.files[path].read_bytes()


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
    """The page with a bundle.

    Raises:
        PageError: the page was not built, or a file of the bundle lies elsewhere.
        BundleError: the folder is not a bundle, or its bundle.json is damaged.
    """
    info = read_manifest(bundle)
    folder = bundle.resolve()
    if folder.is_file():
        raise PageError(f"{bundle} is a bundle in one file, which the viewer does not open yet: give it the folder")
    files = dict(page_files())
    for name in (MANIFEST, *info.files):
        path = folder / name
        if media_type(name).startswith("text/"):
            continue  # a page or a script has no place in a bundle
        if path.resolve().parent != folder:
            raise PageError(f"{path} is a link that leads out of the bundle: it is not shown")
        files[f"{BUNDLE}{name}"] = path
    title = json.dumps({"title": folder.parent.name if folder.name == "bundle" else folder.name})
    return Site(files, {"view.json": title.encode()})
