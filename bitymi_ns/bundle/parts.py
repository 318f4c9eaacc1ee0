"""Files of a bundle, a folder or one file: opening, names, target folder."""

import os
import re
import struct
import warnings
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from io import BufferedReader
from pathlib import Path
from typing import NamedTuple

from bitymi_ns import safe_reading
from bitymi_ns.files import reserved, write_errors_as
from bitymi_ns.locks import Tell
from bitymi_ns.trust import check_replaceable, json_of
from .manifest import (
    ATLAS,
    COMPACT_SURFELS,
    MANIFEST,
    POSTER,
    SURFELS,
    TEXELS,
    BundleError,
    Manifest,
    dump,
)

MANIFEST_LIMIT = 4 << 20  # largest bundle.json, bytes
DIRECTORY_LIMIT = 4 << 20  # largest ZIP directory of a bundle in one file, bytes
NOTES, NOTES_LIMIT = "notes.json", 256 << 10  # saved views and notes (`bundle.notes`), and their largest size in bytes
CONFIG = "config.yml"  # configuration for nerfstudio's tools, not covered by the digest
CAMERAS, PREVIEWS = "cameras.json", ("preview.jpg", "preview.png")
_PHOTOGRAPH = re.compile(r"photograph-[0-9]{4,6}\.jpg")
_PART = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")
# Records of a ZIP: a part's header, a row of the directory; ZIP64 end of directory, its locator, end of directory.
_LOCAL, _CENTRAL = struct.Struct("<4s22xHH"), struct.Struct("<4s6xH8xLLHHH8xL")
_LARGE = struct.Struct("<4s36xQQ")
_LARGE_AT = struct.Struct("<4s4xQ4x")
_END = struct.Struct("<4s8xLLH")
_WIDE = 0xFFFFFFFF  # a number that stands in the row's ZIP64 field
_SLACK = 64  # most bytes by which a part's header is longer than 30 and its name


class MissingPart(BundleError):
    """A file that the bundle lacks."""


def is_known(name: str) -> bool:
    """Return True for file names of the format; other files of a bundle are not copied with it."""
    known = (MANIFEST, SURFELS, ATLAS, COMPACT_SURFELS, TEXELS, POSTER, CAMERAS, *PREVIEWS)
    return name in known or _PHOTOGRAPH.fullmatch(name) is not None


def left_out(info: Manifest) -> list[str]:
    """List the files in bundle.json that are not copied with the bundle."""
    return [name for name in info.files if not is_known(name)]


def public_manifest(info: Manifest, data: bytes) -> bytes:
    """Return bundle.json for a copy: `data`, or a version without the files that are left out."""
    if not left_out(info):
        return data
    return dump(info.model_copy(update={"files": {name: e for name, e in info.files.items() if is_known(name)}}))


def open_regular(path: Path) -> BufferedReader:
    """Open a file of a bundle as `safe_reading.open_regular` does. Raises BundleError: missing or unreadable."""
    try:
        return safe_reading.open_regular(path)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise MissingPart(f"{path} is missing") from error
    except OSError as error:
        raise BundleError(f"{path} cannot be read: {error.strerror}") from error


class _Entry(NamedTuple):
    """Row of a single file's directory."""

    begin: int  # of the part's header
    size: int
    stored: bool  # as it is, not deflated


class Parts:
    """Files of a bundle by name."""

    def __init__(self, bundle: Path, file: BufferedReader | None = None, inside: bool = False) -> None:
        """Prefer `parts_of`. `bundle`: folder or file. `file`: the opened single file; None for a folder."""
        self.bundle, self._file, self._inside = bundle, file, inside
        self._entries, self._end = ({}, 0) if file is None else _read_directory(file)

    @contextmanager
    def opened(self, name: str) -> Iterator[tuple[BufferedReader, int]]:
        """Open a file; yield it, at its beginning, and its size in bytes: no more may be read. Raises BundleError:
        missing or unreadable."""
        path = self.bundle / name
        try:
            if self._file is not None:
                yield self._file, self._seek(self._file, name)
                return
            with open_regular(path) as file:
                if self._inside and os.path.dirname(os.path.realpath(path)) != os.path.realpath(self.bundle):
                    raise BundleError(f"{path} is a link that leads out of the bundle")
                yield file, os.fstat(file.fileno()).st_size
        except OSError as error:
            raise BundleError(f"{path} cannot be read: {error.strerror}") from error

    def _seek(self, file: BufferedReader, name: str) -> int:
        """Move to the beginning of a part of the single file; return its size."""
        if name not in self._entries:
            raise MissingPart(f"{self.bundle} has no {name}")
        begin, size, stored = self._entries[name]
        if not stored:
            raise BundleError(f"{self.bundle}: {name} is not stored as it is")
        file.seek(min(begin, self._end))
        signature, *lengths = _LOCAL.unpack(file.read(_LOCAL.size).ljust(_LOCAL.size, b"\0"))
        begin += _LOCAL.size + sum(lengths)
        if signature != b"PK\3\4" or sum(lengths) > len(name) + _SLACK or begin + size > self._end:
            raise BundleError(f"{self.bundle} is truncated or altered: {name} does not lie where its directory says")
        file.seek(begin)
        return size

    def read(self, name: str, most: int) -> bytes:
        """Read a file of at most `most` bytes. Raises BundleError: missing, larger, or unreadable."""
        with self.opened(name) as (file, size):
            if size > most:
                raise BundleError(f"{self.bundle / name} has {size} bytes, at most {most} are read")
            return file.read(size)


@contextmanager
def parts_of(bundle: str | Path, inside: bool = False) -> Iterator[Parts]:
    """Open the files of a bundle, a folder or single file. `inside`: refuse links out of the folder, for copying.
    Raises BundleError: the single file is damaged."""
    path = Path(bundle)
    if not os.path.isfile(path):
        yield Parts(path, inside=inside)
        return
    with open_regular(path) as file:
        try:
            parts = Parts(path, file)
        except OSError as error:
            raise BundleError(f"{path} cannot be read: {error.strerror or error}") from error
        except ValueError as error:
            why = instead_of(path)
            raise BundleError(f"{path} is not a bundle{f': {why}' if why else f' in one file: {error}'}") from error
        yield parts


def _read_directory(file: BufferedReader) -> tuple[dict[str, _Entry], int]:
    """Read the directory of a single file as web/src/bundle/archive.ts does: where parts are said to be, by name, and
    where the directory begins. Raises ValueError: there is none, or the file does not begin with the first part and
    could be of another type, too."""
    size = file.seek(0, os.SEEK_END)
    records = _LARGE.size + _LARGE_AT.size + _END.size
    file.seek(max(0, size - records))
    tail = file.read(records).rjust(records, b"\0")
    end, length, begin, comment = _END.unpack(tail[-_END.size :])
    if end != b"PK\5\6" or comment:
        raise ValueError("it is truncated, or something else")
    there, at = _LARGE_AT.unpack(tail[_LARGE.size : -_END.size])
    behind = _END.size
    if there == b"PK\6\7":
        large, length, begin = _LARGE.unpack(tail[: _LARGE.size])
        behind = records if large == b"PK\6\6" and at == size - records else 0
    if length > DIRECTORY_LIMIT:
        raise ValueError(f"its directory has {length} bytes, at most {DIRECTORY_LIMIT} are read")
    if begin + length != size - behind:
        raise ValueError("its directory is not where its last record says")
    file.seek(begin)
    directory, at, entries = file.read(length), 0, {}
    while at < length:
        row = directory[at : at + _CENTRAL.size].ljust(_CENTRAL.size, b"\0")
        signature, method, packed, size, *lengths, offset = _CENTRAL.unpack(row)
        at += _CENTRAL.size
        name = directory[at : at + lengths[0]].decode("latin-1")
        extra = directory[at + lengths[0] : at + sum(lengths[:2])]
        at += sum(lengths)
        if signature != b"PK\1\2" or at > length:
            raise ValueError("its directory is damaged")
        wide = iter(struct.unpack_from(f"<{len(extra) // 8}Q", extra, 4) if extra[:2] == b"\1\0" else ())
        size, packed, offset = (next(wide, n) if n == _WIDE else n for n in (size, packed, offset))
        if name in entries:
            raise ValueError("two parts have one name")
        if _PART.fullmatch(name):
            entries[name] = _Entry(offset, size, method == 0 and packed == size)
    return entries, begin


def notes_data(parts: Parts) -> bytes | None:
    """Read notes.json, unchecked; None if there is none. Raises BundleError: unreadable, or too large."""
    try:
        return parts.read(NOTES, NOTES_LIMIT)
    except MissingPart:
        return None


def bundle_at(path: Path) -> Path | None:
    """Find the bundle of a path: itself, or its parent (as for config.yml)."""
    return next((place for place in (path, path.parent) if (place / MANIFEST).is_file() or _is_archive(place)), None)


def instead_of(path: Path) -> str | None:
    """Explain a path that is not a bundle and suggest another, if possible."""
    if not os.path.lexists(path):
        return "it does not exist"
    bundle = next((place for place in (path.parent, path / "bundle") if (place / MANIFEST).is_file()), None)
    if bundle is not None:
        return f"give {bundle}"
    for run in (path, path.parent, path.parent.parent):
        if (run / CONFIG).is_file() and next(run.glob("*/step-*.ckpt"), None) is not None:
            command = f"ns-export bitymi-atlas --load-config {run / CONFIG} --output-dir bundle"
            return f"it is a training run, which has to be exported first: {command}"
    return None


def _is_archive(path: Path) -> bool:
    """Return True for a file with the signature of a bundle in one file."""
    try:
        with safe_reading.open_regular(path) as file:
            return file.read(4) == b"PK\3\4"
    except OSError:
        return False


def check_target(folder: str | Path, overwrite: bool = False) -> None:
    """Check that a bundle may be written to a folder. Raises BundleError: it exists and `overwrite` is off, is not a
    bundle, or holds foreign files or an unreadable notes.json."""
    folder = Path(folder)
    made = _replaced(folder) if (folder / MANIFEST).is_file() else None
    check_replaceable(folder, f"a bundle (it has no {MANIFEST})", made, overwrite, BundleError, "--overwrite True")


@contextmanager
def reserved_bundle(folder: str | Path, overwrite: bool, tell: Tell = warnings.warn, then: str = "") -> Iterator[None]:
    """Lock the folder of a bundle for the block; `then` ends the message of an error. Raises BundleError: as
    `check_target`, or the folder is in use or cannot be written."""
    folder = Path(folder)
    with ExitStack() as stack:
        with write_errors_as(folder, BundleError, then):
            stack.enter_context(reserved(folder, lambda: check_target(folder, overwrite), tell))
        yield


def _replaced(folder: Path) -> Iterator[str]:
    """Yield the files of a bundle, and its notes.json, which must be readable."""
    with parts_of(folder) as parts:
        notes_data(parts)
    yield from (*files_of(folder), NOTES)


def files_of(folder: Path) -> list[str]:
    """List the files of a bundle of any version, with config.yml, and cameras.json, which early bundles did not list.
    Raises BundleError: bundle.json is unreadable."""
    try:
        with parts_of(folder) as parts:
            listed = json_of(bytes(parts.read(MANIFEST, MANIFEST_LIMIT)))["files"]
        return [MANIFEST, CONFIG, CAMERAS, *map(str, listed)]
    except (OSError, ValueError, LookupError, TypeError) as error:
        unknown = f"which files of {folder} are the bundle is not known"
        remedy = "Remove it yourself, or choose another folder"
        raise BundleError(f"{folder / MANIFEST} cannot be read ({error}): {unknown}. {remedy}") from error
