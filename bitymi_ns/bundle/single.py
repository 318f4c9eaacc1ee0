"""A bundle in one file: an uncompressed ZIP whose parts lie in the order in which a viewer needs them; and such a file
as a folder again."""

import io
import os
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from bitymi_ns.bundle.manifest import ATLAS, COMPACT_SURFELS, MANIFEST, POSTER, SURFELS, TEXELS, BundleError, Manifest
from bitymi_ns.bundle.notes import read_notes
from bitymi_ns.bundle.parts import MANIFEST_LIMIT, NOTES, Parts, is_known, left_out, parts_of, passed_on
from bitymi_ns.bundle.read import manifest_of, read_file, read_manifest
from bitymi_ns.bundle.sizes import enough_memory, machine_memory
from bitymi_ns.files import complete_folder, size_text, write_file

_ORDER = (POSTER, COMPACT_SURFELS, TEXELS, SURFELS, ATLAS)
SUFFIX = ".bitymi"  # suffix of such a file
_DATE = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True)
class Written:
    """Sizes of a written file."""

    first: int  # bytes from the start to the end of the surfels
    bytes: int  # of the file
    left_out: list[str]  # files that the bundle lists and the format does not name, which the file does not have


def write_single(bundle: str | Path, path: str | Path) -> Written:
    """Write the files of a bundle that bundle.json lists and the format names into one, whole or not at all; and its
    notes.json.

    Nothing is deflated, sizes stand before the parts, and bundle.json comes first: a reader of the beginning knows
    where everything lies, and any part is one range of the file.

    Args:
        bundle: its folder, or such a file.

    Raises:
        BundleError: there is no bundle, a file is missing or altered, or there is too little memory.
    """
    data, written = joined(bundle)
    write_file(Path(path), data)
    return written


def is_single(path: Path) -> bool:
    """True where a file is a bundle, which another one may replace.

    Raises:
        BundleError: the system cannot read it now.
    """
    try:
        read_manifest(path)
    except BundleError as error:
        if isinstance(error.__cause__, OSError):
            raise
        return False
    return path.is_file()


def joined(bundle: str | Path) -> tuple[bytes, Written]:
    """Contents of `write_single`'s file, and what it returns; raises as it does."""
    first, buffer = 0, io.BytesIO()
    with parts_of(bundle, inside=True) as parts:
        info = manifest_of(parts)
        needed, there = 2 * sum(info.files[name].bytes for name in _names(info)), machine_memory()
        if needed > there:
            why = f"one file of it takes {size_text(needed)} of memory to make, this machine has {size_text(there)}"
            raise BundleError(f"{parts.bundle} cannot be packed: {why}")
        with enough_memory(parts.bundle, info), zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
            for name, data in _contents(parts, info):
                archive.writestr(zipfile.ZipInfo(name, _DATE), data)
                if name == info.surfels.file:
                    first = buffer.tell()
        with enough_memory(parts.bundle, info):
            whole = buffer.getvalue()
    return whole, Written(first, len(whole), left_out(info))


def write_folder(bundle: str | Path, folder: Path, beside: Mapping[str, bytes]) -> list[str]:
    """Write the files of a bundle to a folder, whole or not at all.

    Args:
        bundle: its one file, or its folder.
        folder: that is not there yet, or empty.
        beside: further files by name, for which bundle.json does not vouch.

    Returns:
        files that the bundle lists and the format does not name, which were not written.

    Raises:
        BundleError: there is no bundle, a file is missing or altered, there is too little memory, or something is in
            the place of the folder.
        OSError: it cannot be written.
    """

    def check() -> None:
        if os.path.lexists(folder) and not (folder.is_dir() and not any(folder.iterdir())):
            raise BundleError(f"{folder} is there already: choose another folder (--output)")

    with parts_of(bundle, inside=True) as parts:
        info = manifest_of(parts)
        with complete_folder(folder, check) as new, enough_memory(parts.bundle, info):
            for name, data in chain(_contents(parts, info), beside.items()):
                (new / name).write_bytes(data)
    return left_out(info)


def _names(info: Manifest) -> list[str]:
    """The files that are passed on, in the order in which a viewer needs them."""
    known = filter(is_known, info.files)
    return sorted(known, key=lambda name: (_ORDER.index(name) if name in _ORDER else len(_ORDER), name))


def _contents(parts: Parts, info: Manifest) -> Iterator[tuple[str, bytes | bytearray]]:
    """Name and bytes of all files that are passed on, bundle.json first, each compared with its hash."""
    yield MANIFEST, passed_on(info, parts.read(MANIFEST, MANIFEST_LIMIT))
    for name in _names(info):
        yield name, read_file(parts, info, name)
    if (notes := read_notes(parts)) is not None:
        yield NOTES, notes[0]
