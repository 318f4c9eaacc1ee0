"""Reading of untrusted files: only regular ones are opened, sizes are checked first, and errors name file and entry."""

from __future__ import annotations

import codecs
import errno
import os
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BufferedReader, TextIOWrapper
from pathlib import Path
from typing import Any, TextIO

from pydantic import ValidationError
from rich.filesize import decimal

from .exit_messages import out_of_memory
from .ranges import describe_problems
from .trust import LONGEST, json_of

MOST_TEXT = 1 << 30  # most bytes of JSON or text; 100,000 photographs need a tenth of it


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file, also through a link; opening a pipe would block. Raises OSError, `strerror` says why."""
    try:
        found = os.stat(path)
    except ValueError:  # a null character
        raise OSError(errno.EINVAL, "no file can have this name", str(path)) from None
    if stat.S_ISREG(found.st_mode):
        # O_NONBLOCK: it may have become a pipe
        file = open(path, "rb", opener=lambda name, flags: os.open(name, flags | os.O_NONBLOCK))
        if stat.S_ISREG(os.fstat(file.fileno()).st_mode):
            return file
        file.close()
    raise OSError(errno.EINVAL, "it is not a regular file", str(path))


def read_bytes(path: Path, most: int = MOST_TEXT) -> bytes:
    """Read a file of at most `most` bytes. Raises OSError: it is no regular file, larger, or cannot be read."""
    with open_regular(path) as file:
        size = os.fstat(file.fileno()).st_size
        _check_size(path, size, most)
        return file.read(size)


def open_text(path: Path, errors: str = "strict") -> TextIO:
    """Open a text file in the encoding of its byte order mark (of Windows programs), or else in UTF-8."""
    file = open_regular(path)
    wide = file.peek(2)[:2] in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
    return TextIOWrapper(file, encoding="utf-16" if wide else "utf-8-sig", errors=errors)


def read_text(path: Path, most: int = MOST_TEXT) -> str:
    """Read as `open_text` a file of at most `most` bytes. Raises OSError; UnicodeDecodeError: it is no text."""
    with open_text(path) as file:
        _check_size(path, os.fstat(file.fileno()).st_size, most)
        return file.read()


def _check_size(path: Path, size: int, most: int) -> None:
    if size > most:
        raise OSError(errno.EFBIG, f"it has {decimal(size)}, at most {decimal(most)} are read", str(path))


def read_json(path: Path, most: int = MOST_TEXT) -> Any:
    """Read a JSON file. Raises OSError: see `read_bytes`; ValueError: it is no JSON, or is nested too deeply."""
    return json_of(read_bytes(path, most))


def why(error: BaseException) -> str:
    """Describe a reading error in one line, without a full stop."""
    if isinstance(error, FileNotFoundError):
        return "it is a link to nothing" if os.path.islink(error.filename or "") else "it does not exist"
    if isinstance(error, OSError) and error.strerror:
        return error.strerror
    if isinstance(error, UnicodeDecodeError):
        return f"it is no text in {error.encoding.upper()} (byte {error.start})"
    if isinstance(error, KeyError):
        return f"the entry {error} is missing"
    if isinstance(error, ValidationError):
        return describe_problems(error)
    if out_of_memory(error):
        return "it takes more memory than there is"
    if isinstance(error, RecursionError):
        return "it is nested too deeply"
    if isinstance(error, OverflowError):
        return "a number in it is too large"
    return (str(error).strip() or type(error).__name__).splitlines()[0][:LONGEST].rstrip(". ")


@contextmanager
def reading(
    what: object,
    refuse: Callable[[str], BaseException],
    advice: str = "",
    passing: tuple[type[BaseException], ...] = (),
) -> Iterator[None]:
    """Convert any exception in the block, which reads untrusted data, to a one-line message of place and cause. `what`:
    file and entry, as in "a.json: frame 3". `refuse`: makes the exception from the message. `advice`: what to do,
    unless memory ran out. `passing`: exceptions that are passed on."""
    try:
        yield
    except passing:
        raise
    except Exception as error:
        then = "End other programs, or make it smaller." if out_of_memory(error) else advice
        raise refuse(f"{what} cannot be read: {why(error)}.{' ' + then if then else ''}") from error
