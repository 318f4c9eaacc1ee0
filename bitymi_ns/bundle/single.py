"""A bundle in one file: a ZIP whose parts are stored as they are, in the order in which a viewer needs them."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from bitymi_ns.bundle.manifest import ATLAS, COMPACT_SURFELS, MANIFEST, POSTER, SURFELS, TEXELS, BundleError, parse
from bitymi_ns.bundle.parts import MANIFEST_LIMIT, is_known, left_out, parts_of, passed_on
from bitymi_ns.bundle.read import Bundle, assemble, manifest_of, read_file, read_manifest
from bitymi_ns.bundle.sizes import enough_memory, machine_memory
from bitymi_ns.files import size_text, write_file

_ORDER = (POSTER, COMPACT_SURFELS, TEXELS, SURFELS, ATLAS)
SUFFIX = ".bitymi"
"""Of the name of such a file."""
_DATE = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True)
class Written:
    """What was written.

    Attributes:
        first: bytes from the start to the end of the surfels.
        bytes: of the file.
        left_out: files that the bundle lists and the format does not name, which the file does not have.
    """

    first: int
    bytes: int
    left_out: list[str]


def write_single(bundle: str | Path, path: str | Path) -> Written:
    """Writes the files of a bundle that bundle.json vouches for and the format names into one, whole or not at all.

    Nothing is deflated, sizes stand before the parts, and bundle.json comes first: a reader of the beginning knows
    where everything lies, and any part is one range of the file.

    Args:
        bundle: its folder, or such a file.
        path: the file to write.

    Raises:
        BundleError: there is no bundle, a file is missing or altered, or there is too little memory.
    """
    data, written = joined(bundle)
    write_file(Path(path), data)
    return written


def is_single(path: Path) -> bool:
    """Whether a file is a bundle, and may be replaced by another one."""
    try:
        read_manifest(path)
    except BundleError:
        return False
    return path.is_file()


def joined(bundle: str | Path) -> tuple[bytes, Written]:
    """What `write_single` writes, and what it says of it; raises as it does."""
    first, buffer = 0, io.BytesIO()
    with parts_of(bundle, inside=True) as parts:
        info = manifest_of(parts)
        names = [name for name in info.files if is_known(name)]
        needed, there = 2 * sum(info.files[name].bytes for name in names), machine_memory()
        if needed > there:
            why = f"one file of it takes {size_text(needed)} of memory to make, this machine has {size_text(there)}"
            raise BundleError(f"{parts.bundle} cannot be packed: {why}")
        with enough_memory(parts.bundle, info), zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
            for name in [MANIFEST, *sorted(names, key=lambda n: (_ORDER.index(n) if n in _ORDER else len(_ORDER), n))]:
                if name == MANIFEST:
                    data: bytes | bytearray = passed_on(info, parts.read(MANIFEST, MANIFEST_LIMIT))
                else:
                    data = read_file(parts, info, name)
                archive.writestr(zipfile.ZipInfo(name, _DATE), data)
                if name == info.surfels.file:
                    first = buffer.tell()
        with enough_memory(parts.bundle, info):
            whole = buffer.getvalue()
    return whole, Written(first, len(whole), left_out(info))


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
    with parts_of(file, source) as parts:
        info = parse(parts.read(MANIFEST, MANIFEST_LIMIT), f"{source}: {MANIFEST}")
        if not textured and info.surfels.file != COMPACT_SURFELS:
            raise BundleError(f"{source}: only a compact bundle can be opened without its texels")
        wanted = {info.surfels.file} | ({info.atlas.file} if info.atlas is not None and textured else set())
        with enough_memory(parts.bundle, info):
            files = {name: read_file(parts, info, name, verify) for name in sorted(wanted)}
            return assemble(parts.bundle, info, files, textured=textured)


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
