"""Bundle in one file: an uncompressed ZIP with its parts in the order a viewer needs them."""

import io
import os
import zipfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from itertools import chain
from pathlib import Path

from bitymi_ns.files import complete_file, complete_folder, size_text
from .manifest import ATLAS, COMPACT_SURFELS, MANIFEST, POSTER, SURFELS, TEXELS, BundleError, Manifest
from .notes import read_notes
from .parts import MANIFEST_LIMIT, NOTES, Parts, is_known, left_out, parts_of, public_manifest
from .read import manifest_of, read_file, read_manifest
from .sizes import enough_memory, machine_memory

_ORDER = (POSTER, COMPACT_SURFELS, TEXELS, SURFELS, ATLAS)
SUFFIX = ".bitymi"
_DATE = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True)
class SingleFile:
    """Sizes of a written file, in bytes."""

    first: int  # from the start to the end of the surfels
    bytes: int
    left_out: list[str]  # as `parts.left_out`


def write_single(bundle: str | Path, path: str | Path) -> SingleFile:
    """Write a bundle, a folder or such a file, to one file, atomically: the files of the format that bundle.json lists,
    and notes.json.

    Nothing is deflated, sizes precede the parts, and bundle.json comes first: the beginning of the file tells where
    each part lies. Raises BundleError: no bundle, a file is missing or altered, or memory is insufficient."""
    data, written = joined(bundle)
    with complete_file(Path(path), follow=True) as file:
        file.write(data)
        file.flush()
        with parts_of(file.name) as parts:
            info = manifest_of(parts)
            for name in info.files:
                read_file(parts, info, name, keep=False)
    return written


def is_single(path: Path) -> bool:
    """Return True if a file is a bundle. Raises BundleError: the system cannot read it."""
    try:
        read_manifest(path)
    except BundleError as error:
        if isinstance(error.__cause__, OSError):
            raise
        return False
    return path.is_file()


def joined(bundle: str | Path) -> tuple[bytes, SingleFile]:
    """Build the contents of `write_single`'s file; raises as it does."""
    first, buffer = 0, io.BytesIO()
    with parts_of(bundle, inside=True) as parts:
        info = manifest_of(parts)
        needed = 2 * sum(info.files[name].bytes for name in _names(info))
        there = machine_memory()
        if needed > there:
            why = f"that takes {size_text(needed)} of memory, this machine has {size_text(there)}"
            raise BundleError(f"{parts.bundle} cannot be packed: {why}")
        with enough_memory(parts.bundle, info), zipfile.ZipFile(buffer, "w", zipfile.ZIP_STORED) as archive:
            for name, data in _contents(parts, info):
                archive.writestr(zipfile.ZipInfo(name, _DATE), data)
                if name == info.surfels.file:
                    first = buffer.tell()
        with enough_memory(parts.bundle, info):
            whole = buffer.getvalue()
    return whole, SingleFile(first, len(whole), left_out(info))


def write_folder(bundle: str | Path, folder: Path, beside: Mapping[str, bytes]) -> list[str]:
    """Write the files of a bundle, a folder or single file, to a missing or empty folder, atomically. `beside`: further
    files by name, not covered by bundle.json. Returns `SingleFile.left_out`. Raises
    BundleError: as `write_single`, or the folder is occupied. Raises OSError: it cannot be written."""

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
    """List the files to copy, in the order a viewer needs them."""
    known = filter(is_known, info.files)
    return sorted(known, key=lambda name: (_ORDER.index(name) if name in _ORDER else len(_ORDER), name))


def _contents(parts: Parts, info: Manifest) -> Iterator[tuple[str, bytes | bytearray]]:
    """Yield name and bytes of each file to copy, compared with its hash."""
    yield MANIFEST, public_manifest(info, parts.read(MANIFEST, MANIFEST_LIMIT))
    for name in _names(info):
        yield name, read_file(parts, info, name)
    if (notes := read_notes(parts)) is not None:
        yield NOTES, notes[0]
