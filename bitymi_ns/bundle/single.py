"""A bundle in one file: a ZIP whose parts are stored as they are, in the order in which a viewer needs them."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from bitymi_ns.bundle.archive import opened
from bitymi_ns.bundle.manifest import ATLAS, COMPACT_SURFELS, MANIFEST, POSTER, SURFELS, TEXELS, BundleError, parse
from bitymi_ns.bundle.read import MANIFEST_LIMIT, Bundle, assemble, check_bytes, enough_memory, read_manifest
from bitymi_ns.files import write_file

_ORDER = (MANIFEST, POSTER, COMPACT_SURFELS, TEXELS, SURFELS, ATLAS)
SUFFIX = ".bitymi"
"""Of the name of such a file."""
_DATE = (1980, 1, 1, 0, 0, 0)


def write_single(folder: str | Path, path: str | Path) -> tuple[int, int]:
    """Writes the files of a bundle that bundle.json vouches for into one, whole or not at all.

    Nothing is deflated, sizes stand before the parts, and bundle.json comes first: a reader of the beginning knows
    where everything lies, and any part is one range of the file.

    Returns:
        bytes from the start to the end of the surfels, and of the file.

    Raises:
        BundleError: the folder is not a bundle, or a file is missing or altered.
    """
    data, first = _joined(Path(folder))
    write_file(Path(path), data)
    return first, len(data)


def is_single(path: Path) -> bool:
    """Whether a file is a bundle, and may be replaced by another one."""
    try:
        read_manifest(path)
    except BundleError:
        return False
    return path.is_file()


def single_bytes(folder: Path) -> bytes:
    """What `write_single` writes; raises as it does."""
    return _joined(folder)[0]


def _joined(folder: Path) -> tuple[bytes, int]:
    """The file, and its bytes from the start to the end of the surfels."""
    info = read_manifest(folder)
    names, first = [MANIFEST, *info.files], 0
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
        for name in sorted(names, key=lambda n: (_ORDER.index(n) if n in _ORDER else len(_ORDER), n)):
            try:
                data = (folder / name).read_bytes()
            except OSError as error:
                raise BundleError(f"{folder / name} cannot be read: {error}") from error
            if name != MANIFEST:
                check_bytes(folder / name, info, name, data)
            archive.writestr(zipfile.ZipInfo(name, _DATE), data)
            if name == info.surfels.file:
                first = buffer.tell()
    return buffer.getvalue(), first


def read_single(file: BinaryIO, textured: bool = True, verify: bool = True, source: str = "the bundle") -> Bundle:
    """Opens a bundle of `write_single`, of which no more is read than is needed.

    Args:
        file: seekable; `Ranges` is one of a server that answers range requests.
        textured: False leaves the texels alone: every surfel then shows its constant residual.
        verify: compare the parts with their SHA-256.
        source: for messages.

    Raises:
        BundleError: the file is damaged, or what is in it.
    """
    where = Path(source)
    with opened(file, source) as archive:
        info = parse(archive.part(MANIFEST, MANIFEST_LIMIT), f"{source}: {MANIFEST}")
        if not textured and info.surfels.file != COMPACT_SURFELS:
            raise BundleError(f"{source}: only a compact bundle can be opened without its texels")
        wanted = {info.surfels.file} | ({info.atlas.file} if info.atlas is not None and textured else set())
        with enough_memory(where, info):
            files = {}
            for name in sorted(wanted):
                data = archive.part(name, info.files[name].bytes)
                check_bytes(where / name, info, name, data, verify)
                files[name] = bytearray(data)
            return assemble(where, info, files, textured=textured)


class Ranges(io.RawIOBase):
    """A file of which pieces are fetched when they are read."""

    def __init__(self, fetch: Callable[[int, int], bytes], size: int) -> None:
        """
        Args:
            fetch: the bytes from a position, and how many of them.
            size: of the file.
        """
        self._fetch, self._size, self._at = fetch, size, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def tell(self) -> int:
        return self._at

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        base = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._size}[whence]
        self._at = max(0, base + offset)
        return self._at

    def read(self, size: int | None = -1) -> bytes:
        left = max(0, self._size - self._at)
        count = left if size is None or size < 0 else min(size, left)
        data = self._fetch(self._at, count) if count else b""
        self._at += len(data)
        return data
