"""Files of a bundle, a folder or one file: opening them, their names, and the folder to write."""

import os
import re
import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import IO, BinaryIO

from bitymi_ns import reading
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
from bitymi_ns.trust import Refused, json_of, keep

MANIFEST_LIMIT = 4 << 20  # bytes that a bundle.json may have
DIRECTORY_LIMIT = 4 << 20  # bytes that the directory of a bundle in one file may have
NOTES, NOTES_LIMIT = "notes.json", 256 << 10  # saved views and notes: `bundle.notes`; its bytes at most
CONFIG = "config.yml"  # configuration for nerfstudio's tools, for which bundle.json does not vouch
CAMERAS, PREVIEWS = "cameras.json", ("preview.jpg", "preview.png")
_PHOTOGRAPH = re.compile(r"photograph-[0-9]{4,6}\.jpg")
# The last records of a ZIP: where that of large files is, that of large files itself, and the end.
_LARGE, _LARGE_AT, _END = struct.Struct("<4s36xQQ"), struct.Struct("<4s4xQ4x"), struct.Struct("<4s8xLLH")


class MissingPart(BundleError):
    """A bundle has no file of a name."""


def is_known(name: str) -> bool:
    """True for the names of the format. Other files may lie in a bundle; they are not passed on."""
    known = (MANIFEST, SURFELS, ATLAS, COMPACT_SURFELS, TEXELS, POSTER, CAMERAS, *PREVIEWS)
    return name in known or _PHOTOGRAPH.fullmatch(name) is not None


def left_out(info: Manifest) -> list[str]:
    """The files that a bundle lists and that are not passed on with it."""
    return [name for name in info.files if not is_known(name)]


def passed_on(info: Manifest, data: bytes) -> bytes:
    """The bundle.json that is passed on: `data`, if all files that it lists are; else one that lists those alone."""
    if not left_out(info):
        return data
    return dump(info.model_copy(update={"files": {name: e for name, e in info.files.items() if is_known(name)}}))


def open_regular(path: Path) -> BinaryIO:
    """Open a file of a bundle for reading, see `reading.open_regular`.

    Raises:
        BundleError: there is no such file, it is something else, or the system refuses it.
    """
    try:
        return reading.open_regular(path)
    except (FileNotFoundError, NotADirectoryError) as error:
        raise MissingPart(f"{path} is missing") from error
    except OSError as error:
        raise BundleError(f"{path} cannot be read: {error.strerror}") from error


class Parts:
    """The files of a bundle, by name."""

    def __init__(self, bundle: Path, archive: zipfile.ZipFile | None, size: int, inside: bool) -> None:
        """See `parts_of`.

        Args:
            bundle: the folder or the file, also for messages.
            archive: None for a folder.
            size: bytes of the one file.
            inside: refuse links that lead out of the folder.
        """
        self.bundle, self._archive, self._size, self._inside = bundle, archive, size, inside

    @contextmanager
    def opened(self, name: str) -> Iterator[tuple[IO[bytes], int]]:
        """A file, and how many bytes it has; nothing has been read of it.

        Raises:
            BundleError: there is no such file, or it is none that can be read.
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
        """All bytes of a file that may have at most so many, which is seen before it is read.

        Raises:
            BundleError: there is no such file, it is larger, or it cannot be read.
        """
        with self.opened(name) as (file, size):
            if size > most:
                raise BundleError(f"{self.bundle / name} has {size} bytes, at most {most} are read")
            return file.read(size)


_DAMAGE = (zipfile.BadZipFile, OSError, EOFError, RuntimeError, struct.error)
"""Errors of `zipfile` for other or damaged files."""


@contextmanager
def parts_of(bundle: str | Path, inside: bool = False) -> Iterator[Parts]:
    """Open the files of a bundle.

    Args:
        bundle: its folder, or its one file.
        inside: refuse links that lead out of the folder, because what is read is passed on.

    Raises:
        BundleError: the one file is damaged.
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
    """Size of a file. Raises a ValueError for one whose directory exceeds `DIRECTORY_LIMIT`, which takes `zipfile` long
    to read, or that begins with something else, which may then be of another type, too."""
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
    """Bytes of notes.json, unchecked; None where a bundle has none.

    Raises:
        BundleError: it cannot be read, or has more than `NOTES_LIMIT` bytes.
    """
    try:
        return parts.read(NOTES, NOTES_LIMIT)
    except MissingPart:
        return None


def bundle_at(path: Path) -> Path | None:
    """Find the bundle that a path names: itself, a folder or one file, or what it lies in, as config.yml does; None
    where it names something else."""
    return next((place for place in (path, path.parent) if (place / MANIFEST).is_file() or _is_archive(place)), None)


def instead_of(path: Path) -> str | None:
    """Say what a path that is no bundle is, and what to give in its place; None where that is not known."""
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
    """True for a file that begins as a bundle in one file does."""
    try:
        with reading.open_regular(path) as file:
            return file.read(4) == b"PK\3\4"
    except OSError:
        return False


def check_target(folder: str | Path, overwrite: bool = False) -> None:
    """Check that a bundle may be written to a folder, before the work of making one.

    Raises:
        BundleError: it exists and `overwrite` is off; or it is something other than a bundle, or holds something else,
            or a notes.json that cannot be carried over.
    """
    folder = Path(folder)
    if not os.path.lexists(folder):
        return
    if not folder.is_dir():
        what = "a link to nothing" if folder.is_symlink() and not folder.exists() else "not a folder"
        raise BundleError(f"{folder} is {what}; choose another folder")
    if not any(folder.iterdir()):
        return
    if not (folder / MANIFEST).is_file():
        raise BundleError(
            f"{folder} is not a bundle (it has no {MANIFEST}) and is not overwritten; choose another folder"
        )
    if not overwrite:
        raise BundleError(f"{folder} is a bundle already; choose another folder, or replace it (--overwrite True)")
    with parts_of(folder) as parts:
        notes_data(parts)  # carried over to the new bundle
    try:
        keep(folder, [*files_of(folder), NOTES])
    except Refused as error:
        raise BundleError(str(error)) from error


def files_of(folder: Path) -> list[str]:
    """Names of the files of a bundle of any version: bundle.json, those that it lists, the configuration for
    nerfstudio's tools, and cameras.json, which the first versions of `bake_scene` wrote without listing it.

    Raises:
        BundleError: bundle.json cannot be read.
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
