"""Files of a bundle, a folder or one file: opening, names, target folder."""

import os
import re
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, BinaryIO

from bitymi_ns import safe_reading
from bitymi_ns.bundle.manifest import (
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
from bitymi_ns.trust import check_replaceable, json_of

MANIFEST_LIMIT = 4 << 20  # largest bundle.json, bytes
DIRECTORY_LIMIT = 4 << 20  # largest ZIP directory of a bundle in one file, bytes
NOTES, NOTES_LIMIT = "notes.json", 256 << 10  # saved views and notes (`bundle.notes`), and their largest size in bytes
CONFIG = "config.yml"  # configuration for nerfstudio's tools, not covered by the digest
CAMERAS, PREVIEWS = "cameras.json", ("preview.jpg", "preview.png")
_PHOTOGRAPH = re.compile(r"photograph-[0-9]{4,6}\.jpg")
# Last records of a ZIP: ZIP64 end of directory, its locator, end of directory.
_LARGE, _LARGE_AT, _END = struct.Struct("<4s36xQQ"), struct.Struct("<4s4xQ4x"), struct.Struct("<4s8xLLH")


class MissingPart(BundleError):
    """A file that the bundle lacks."""


def is_known(name: str) -> bool:
    """Return True for file names of the format; a bundle may hold other files, which are not copied with it."""
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


def open_regular(path: Path) -> BinaryIO:
    """Open a file of a bundle for reading with `safe_reading.open_regular`.

    Raises:
        BundleError: missing, not a regular file, or the system refuses it.
    """
    try:
        return safe_reading.open_regular(path)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise MissingPart(f"{path} is missing") from error
    except OSError as error:
        raise BundleError(f"{path} cannot be read: {error.strerror}") from error


class Parts:
    """Files of a bundle by name."""

    def __init__(self, bundle: Path, archive: zipfile.ZipFile | None, size: int, inside: bool) -> None:
        """Prefer `parts_of`.

        Args:
            bundle: folder or file, also for messages.
            archive: None for a folder.
            size: bytes of the single file.
            inside: refuse links out of the folder.
        """
        self.bundle, self._archive, self._size, self._inside = bundle, archive, size, inside

    @contextmanager
    def opened(self, name: str) -> Iterator[tuple[IO[bytes], int]]:
        """Open a file; yield it and its size in bytes.

        Raises:
            BundleError: missing or unreadable.
        """
        path = self.bundle / name
        if self._archive is None:
            with open_regular(path) as file:
                if self._inside and os.path.dirname(os.path.realpath(path)) != os.path.realpath(self.bundle):
                    raise BundleError(f"{path} is a link that leads out of the bundle")
                try:
                    yield file, os.fstat(file.fileno()).st_size
                except OSError as error:
                    raise BundleError(f"{path} cannot be read: {error.strerror}") from error
            return
        entry = self._entry(name)
        try:
            part = self._archive.open(entry)
        except (*_DAMAGE, ValueError) as error:
            raise BundleError(f"{path} cannot be read: {error}") from error
        with part:
            try:
                yield part, entry.file_size
            except _DAMAGE as error:
                raise BundleError(f"{path} cannot be read: {error}") from error

    def _entry(self, name: str) -> zipfile.ZipInfo:
        assert self._archive is not None
        try:
            entry = self._archive.getinfo(name)
        except KeyError as error:
            raise MissingPart(f"{self.bundle} has no {name}") from error
        encrypted = entry.flag_bits & 1
        if entry.compress_type != zipfile.ZIP_STORED or entry.compress_size != entry.file_size or encrypted:
            raise BundleError(f"{self.bundle}: {name} is not stored as it is")
        if not 0 <= entry.header_offset <= self._size - entry.file_size:
            raise BundleError(f"{self.bundle} is truncated: {name} does not lie in it")
        return entry

    def read(self, name: str, most: int) -> bytes:
        """Read a file of at most `most` bytes; the size is checked first.

        Raises:
            BundleError: missing, larger, or unreadable.
        """
        with self.opened(name) as (file, size):
            if size > most:
                raise BundleError(f"{self.bundle / name} has {size} bytes, at most {most} are read")
            return file.read(size)


_DAMAGE = (zipfile.BadZipFile, OSError, EOFError, RuntimeError, struct.error)
"""Errors of `zipfile` on foreign or damaged files."""


@contextmanager
def parts_of(bundle: str | Path, inside: bool = False) -> Iterator[Parts]:
    """Open the files of a bundle.

    Args:
        bundle: folder or single file.
        inside: refuse links out of the folder, because its contents are copied on.

    Raises:
        BundleError: the single file is damaged.
    """
    path = Path(bundle)
    if not os.path.isfile(path):
        yield Parts(path, None, 0, inside)
        return
    with open_regular(path) as file:
        try:
            size = _check_directory(file)
            archive = zipfile.ZipFile(file)
        except (*_DAMAGE, ValueError) as error:
            why = instead_of(path)
            raise BundleError(f"{path} is not a bundle{f': {why}' if why else f' in one file: {error}'}") from error
        with archive:
            if len(archive.NameToInfo) != len(archive.filelist):
                raise BundleError(f"{path} is not a bundle in one file: two parts have one name")
            yield Parts(path, archive, size, inside)


def _check_directory(file: BinaryIO) -> int:
    """Return the size of a file after checking its ZIP directory. Raises a ValueError if the directory exceeds
    `DIRECTORY_LIMIT` (`zipfile` would take long), or if the file starts with anything else: it could then also be of
    another type."""
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
    file.seek(0)
    return size


def notes_data(parts: Parts) -> bytes | None:
    """Read notes.json, unchecked; None if there is none.

    Raises:
        BundleError: unreadable, or more than `NOTES_LIMIT` bytes.
    """
    try:
        return parts.read(NOTES, NOTES_LIMIT)
    except MissingPart:
        return None


def bundle_at(path: Path) -> Path | None:
    """Find the bundle of a path: the path itself, or its parent (as for config.yml); None if there is none."""
    return next((place for place in (path, path.parent) if (place / MANIFEST).is_file() or _is_archive(place)), None)


def instead_of(path: Path) -> str | None:
    """Explain a path that is not a bundle and suggest another; None if nothing is known."""
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
    """Check that a bundle may be written to a folder, before the work of baking it.

    Raises:
        BundleError: it exists and `overwrite` is off; or it is not a bundle, or holds foreign files, or a notes.json
            that cannot be carried over.
    """
    folder = Path(folder)
    made = _replaced(folder) if (folder / MANIFEST).is_file() else None
    check_replaceable(folder, f"a bundle (it has no {MANIFEST})", made, overwrite, BundleError, "--overwrite True")


def _replaced(folder: Path) -> Iterator[str]:
    """Yield the files of a bundle, and its notes.json, which must be readable to be carried over."""
    with parts_of(folder) as parts:
        notes_data(parts)
    yield from (*files_of(folder), NOTES)


def files_of(folder: Path) -> list[str]:
    """List the files of a bundle of any version: bundle.json, the files it lists, config.yml, and cameras.json, which
    the first versions of `bake_scene` did not list.

    Raises:
        BundleError: bundle.json is unreadable.
    """
    try:
        with parts_of(folder) as parts:
            listed = json_of(bytes(parts.read(MANIFEST, MANIFEST_LIMIT)))["files"]
        return [MANIFEST, CONFIG, CAMERAS, *map(str, listed)]
    except (OSError, ValueError, LookupError, TypeError) as error:
        raise BundleError(
            f"{folder / MANIFEST} cannot be read ({error}): which files of {folder} are the bundle is not known. "
            "Remove it yourself, or choose another folder"
        ) from error
