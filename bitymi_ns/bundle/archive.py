"""The parts of a bundle in one file: a ZIP whose parts are stored as they are."""

from __future__ import annotations

import struct
import zipfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from bitymi_ns.bundle.manifest import BundleError


class Archive:
    """An opened file with the parts of a bundle."""

    def __init__(self, archive: zipfile.ZipFile, source: str) -> None:
        self._archive, self._source = archive, source

    def part(self, name: str, most: int) -> bytes:
        """The bytes of a part of at most `most` bytes.

        Raises:
            BundleError: there is none, it is packed, or larger than it may be.
        """
        try:
            entry = self._archive.getinfo(name)
        except KeyError as error:
            raise BundleError(f"{self._source} has no {name}") from error
        if (
            entry.compress_type != zipfile.ZIP_STORED
            or entry.file_size > most
            or entry.compress_size != entry.file_size
        ):
            raise BundleError(f"{self._source}: {name} is not stored as it is, or is larger than stated")
        return self._archive.read(entry)


@contextmanager
def opened(file: str | Path | BinaryIO, source: str) -> Iterator[Archive]:
    """The parts of such a file; whatever is wrong with it while it is read is a BundleError that names `source`."""
    try:
        with zipfile.ZipFile(file) as archive:
            yield Archive(archive, source)
    except BundleError:
        raise
    except (zipfile.BadZipFile, OSError, EOFError, RuntimeError, ValueError, struct.error) as error:
        raise BundleError(f"{source} is not a bundle in one file: {error}") from error
