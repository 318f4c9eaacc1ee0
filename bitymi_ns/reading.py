"""Files that somebody else wrote: opened only where they are files, of a size that is known before they are read, and
whatever is wrong with them said with the file and the entry."""

from __future__ import annotations

import codecs
import errno
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import TextIOWrapper
from pathlib import Path
from typing import Any, BinaryIO, NoReturn, TextIO

from rich.filesize import decimal

from bitymi_ns.trust import json_of

MOST_TEXT = 1 << 30  # bytes of JSON or text; that of 100,000 photographs takes a tenth of it


def open_regular(path: Path) -> BinaryIO:
    """Open a file for reading. A folder, a pipe or a device is refused before it is opened, also where a link leads to
    it: opening a pipe waits for its other end.

    Raises:
        OSError: there is no such file, it is something else, or the system refuses it; `strerror` says which.
    """
    try:
        found = os.stat(path)
    except ValueError:  # a null character
        raise OSError(errno.EINVAL, "no file can have this name", str(path)) from None
    if stat.S_ISREG(found.st_mode):
        # should it have become a pipe by now, opening it does not wait for its other end
        file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))
        if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            return file
        file.close()
    raise OSError(errno.EINVAL, "it is not a regular file", str(path))


def read_bytes(path: Path, most: int = MOST_TEXT) -> bytes:
    """Read a file of at most so many bytes.

    Raises:
        OSError: it is no file, larger, or cannot be read.
    """
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        _check_size(path, size, most)
        return file.read(size)


def open_text(path: Path, errors: str = "strict") -> TextIO:
    """Open a text file, in the encoding of its byte order mark, which editors and shells of Windows write, or else in
    UTF-8. Raises as `open_regular` does."""
    file = open_regular(path)
    wide = file.peek(2)[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)  # type: ignore[attr-defined]
    return TextIOWrapper(file, encoding="utf-16" if wide else "utf-8-sig", errors=errors)


def read_text(path: Path, most: int = MOST_TEXT) -> str:
    """Read a text file, see `open_text`, of at most so many bytes.

    Raises:
        OSError: it is no file, larger, or cannot be read.
        UnicodeDecodeError: it is no text.
    """
    with open_text(path) as file:
        _check_size(path, os.fstat(file.fileno()).st_size, most)
        return file.read()


def _check_size(path: Path, size: int, most: int) -> None:
    if size > most:
        raise OSError(errno.EFBIG, f"it has {decimal(size)}, at most {decimal(most)} are read", str(path))


def read_json(path: Path, most: int = MOST_TEXT) -> Any:
    """Read a file of JSON.

    Raises:
        OSError: see `read_bytes`.
        ValueError: it is no JSON, or is nested too deeply to process.
    """
    return json_of(read_bytes(path, most))


def why(error: BaseException) -> str:
    """Say in one line what is wrong with what was read; without a full stop."""
    if isinstance(error, FileNotFoundError):
        return "it is a link to nothing" if os.path.islink(error.filename or "") else "it does not exist"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    if isinstance(error, UnicodeDecodeError):
        return f"it is no text in {error.encoding.upper()} (byte {error.start})"
    if isinstance(error, KeyError):
        return f"the entry {error} is missing"
    if isinstance(error, MemoryError):
        return "it declares more than memory holds"
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if isinstance(error, OverflowError):
        return "a number in it is too large"
    return (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(". ")


@contextmanager
def reading(
    what: object,
    refuse: Callable[[str, BaseException], NoReturn],
    advice: str = "",
    passing: tuple[type[BaseException], ...] = (),
) -> Iterator[None]:
    """Turn whatever goes wrong in the block, which reads data of others, into one line that says where and what.

    Libraries raise what they like on such data, so no list of exceptions is complete; the cause is kept for debuggers.

    Args:
        what: the file, and the entry of it that is read, as in "a.json: frame 3".
        refuse: raises the exception for a message and its cause.
        advice: ends the message: what to do.
        passing: exceptions that say all of that already.
    """
    try:
        yield
    except passing:
        raise
    except Exception as error:
        refuse(f"{what} cannot be read: {why(error)}.{' ' + advice if advice else ''}", error)
