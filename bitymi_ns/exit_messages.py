"""Termination of commands with one line and no traceback: on interrupts, closed pipes, and lack of space or memory."""

import errno
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from bitymi_ns.files import reason
from bitymi_ns.trust import printable

INTERRUPTED = 130  # exit statuses by shell convention: 128 + signal number
NO_READER = 141
_WRITE_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
_IO_ERRORS = (errno.EIO, errno.EMFILE, errno.ENFILE)


def line_of(error: BaseException) -> str | None:
    """Describe an exception for the user; None: it is a bug, and deserves its traceback."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted; nothing was left half-written"
    if isinstance(error, MemoryError):
        return "there is not enough memory for this; nothing was left half-written"
    if isinstance(error, OSError) and error.errno in (*_WRITE_ERRORS, *_IO_ERRORS):
        what = "cannot be written" if error.errno in _WRITE_ERRORS else "cannot be read or written"
        return f"{error.filename or 'a result'} {what}: {reason(error, Path(str(error.filename)))}"
    return None


def run(command: Callable[[], int]) -> int:
    """Run a command and return its exit status, also after exceptions that `line_of` describes.

    Ends silently if its output is a closed pipe, as with `| head`."""
    try:
        try:
            return command()
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        with suppress(OSError, ValueError):  # stdout may be no file
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes again at exit
        return NO_READER
    except (KeyboardInterrupt, MemoryError, OSError) as error:
        line = line_of(error)
        if line is None:
            raise
        _print_error(line)
        return INTERRUPTED if isinstance(error, KeyboardInterrupt) else 1


def install() -> None:
    """Handle uncaught exceptions of this process as `run` does, in commands of other packages."""
    before = sys.excepthook

    def handle(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        line = line_of(error)
        if line is None:
            before(kind, error, trace)
        else:
            _print_error(line)

    if getattr(before, "__module__", "") != __name__:
        sys.excepthook = handle


def _print_error(line: str) -> None:
    with suppress(OSError):
        print(printable(f"bitymi: {line}"), file=sys.stderr, flush=True)
