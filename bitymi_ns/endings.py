"""End commands that cannot go on, interrupted or without a reader, space or memory, with one line and no traceback."""

import errno
import os
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from types import TracebackType

from bitymi_ns.files import reason
from bitymi_ns.trust import printable

INTERRUPTED = 130  # exit statuses by the convention of shells: 128 and the number of the signal
NO_READER = 141
_OF_WRITING = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
_OF_ANY = (errno.EIO, errno.EMFILE, errno.ENFILE)


def line_of(error: BaseException) -> str | None:
    """Say what to tell the user of an exception that no command expects; None = it is a fault of the program."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted; nothing was left half-written"
    if isinstance(error, MemoryError):
        return "there is not enough memory for this; nothing was left half-written"
    if isinstance(error, OSError) and error.errno in (*_OF_WRITING, *_OF_ANY):
        what = "cannot be written" if error.errno in _OF_WRITING else "cannot be read or written"
        return f"{error.filename or 'a result'} {what}: {reason(error, Path(str(error.filename)))}"
    return None


def run(command: Callable[[], int]) -> int:
    """Run a command to its end, whatever that is; returns its exit status.

    Where nobody reads its output any more, as behind `| head`, it ends silently."""
    try:
        try:
            return command()
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        with suppress(OSError, ValueError):  # of a stream that is no file
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes once more as it ends
        return NO_READER
    except (KeyboardInterrupt, MemoryError, OSError) as error:
        line = line_of(error)
        if line is None:
            raise
        _tell(line)
        return INTERRUPTED if isinstance(error, KeyboardInterrupt) else 1


def install() -> None:
    """Have this process, which runs somebody else's command, end on what nobody caught as `run` does."""
    before = sys.excepthook

    def told(kind: type[BaseException], error: BaseException, trace: TracebackType | None) -> None:
        line = line_of(error)
        if line is None:
            before(kind, error, trace)
        else:
            _tell(line)

    if getattr(before, "__module__", "") != __name__:
        sys.excepthook = told


def _tell(line: str) -> None:
    with suppress(OSError):
        print(printable(f"bitymi: {line}"), file=sys.stderr, flush=True)
