"""End commands with one line, without traceback: on interrupts, closed pipes, and lack of space or memory."""

import atexit
import errno
import os
import re
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, TextIO

from .files import Busy, reason
from .trust import Refused, printable

INTERRUPTED = 130  # exit statuses by shell convention: 128 + signal number
NO_READER = 141
_WRITE_ERRORS = (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS)
_IO_ERRORS = (errno.EIO, errno.EMFILE, errno.ENFILE)
_CAUSES = {
    errno.ENOENT: "it does not exist: check the path",
    errno.EACCES: "you have no permission for it, or for a folder in its path: change the permissions, or the path",
    errno.EPERM: "the system does not permit it: choose another path",
    errno.ENOTDIR: "a part of its path is no folder: check the path",
    errno.EISDIR: "it is a folder: give a file",
    errno.EEXIST: "it is there already: choose another path",
}
_NO_MEMORY = re.compile(
    r"DefaultCPUAllocator|out of memory|bad_alloc|ALLOC_FAILED|\(-4:Insufficient memory\)|Cannot allocate memory"
)

_then: Callable[[], str] = str  # see `install`


def out_of_memory(error: BaseException) -> bool:
    """Test for a MemoryError, or what torch, CUDA, OpenCV and the system raise in its place."""
    return isinstance(error, MemoryError) or isinstance(error, Exception) and _NO_MEMORY.search(str(error)) is not None


def line_of(error: BaseException) -> str | None:
    """Describe an exception for the user: what is wrong, where, and what to do; None for a bug, which deserves its
    traceback."""
    if isinstance(error, KeyboardInterrupt):
        return "interrupted"
    if out_of_memory(error):
        return f"there is not enough memory for this: end other programs, or give it less to do. {_then()}".rstrip()
    if not isinstance(error, OSError):
        return None
    name = os.fsdecode(error.filename) if isinstance(error.filename, (str, bytes, os.PathLike)) else None
    if isinstance(error, (Busy, Refused)):
        return str(error)
    if error.errno in (*_WRITE_ERRORS, *_IO_ERRORS):
        what = "cannot be written" if error.errno in _WRITE_ERRORS else "cannot be read or written"
        return f"{name or 'a result'} {what}: {reason(error, Path(name or 'a result'))}"
    if name is None:
        return None
    cause = _CAUSES.get(error.errno or 0) or f"{error.strerror or error}: check it, or choose another path"
    return f"{name} cannot be read or written: {cause}"


def end_as_by_ctrl_c() -> list[signal.Signals]:
    """Have the signals of batch systems and of terminals that are gone raise KeyboardInterrupt, unless they are handled
    or ignored. Return those that changed."""
    if threading.current_thread() is not threading.main_thread():
        return []
    changed = [number for number in (signal.SIGTERM, signal.SIGHUP) if signal.getsignal(number) == signal.SIG_DFL]
    for number in changed:
        signal.signal(number, signal.default_int_handler)
    return changed


def _end_by_default(numbers: Sequence[int]) -> None:
    for number in numbers:
        signal.signal(number, signal.SIG_DFL)


def run(command: Callable[[], int]) -> int:
    """Run a command and return its exit status, also after exceptions that `line_of` describes; end silently if its
    output is a closed pipe, as with `| head`."""
    changed = end_as_by_ctrl_c()
    try:
        try:
            return command()
        finally:
            sys.stdout.flush()
    except BrokenPipeError:
        with suppress(OSError, ValueError):  # stdout may be no file
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # Python flushes again at exit
        return NO_READER
    except (KeyboardInterrupt, Exception) as error:
        line = line_of(error)
        if line is None:
            raise
        _print_error(line)
        return INTERRUPTED if isinstance(error, KeyboardInterrupt) else 1
    finally:
        _end_by_default(changed)


class _Output:
    """Text stream that drops what nobody takes any more, as after `| head` or in a terminal that is gone."""

    def __init__(self, stream: TextIO) -> None:
        self._stream = stream

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)

    def write(self, text: str) -> int:
        self._try(lambda: self._stream.write(text))
        return len(text)

    def flush(self) -> None:
        self._try(self._stream.flush)

    def _try(self, write: Callable[[], Any]) -> None:
        try:
            write()
        except OSError:
            with suppress(OSError, ValueError):  # it may be no file
                os.dup2(os.open(os.devnull, os.O_WRONLY), self._stream.fileno())


def outlive_output() -> None:
    """Go on when standard output or standard error cannot be written."""
    for name in ("stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is not None and not isinstance(stream, _Output):
            setattr(sys, name, _Output(stream))


def install(then: Callable[[], str] = str) -> None:
    """Handle uncaught exceptions as `run` does, in commands of other packages. `then`: returns what to do after memory
    ran out, beside the usual."""
    global _then
    _then, before = then, sys.excepthook
    atexit.register(_end_by_default, end_as_by_ctrl_c())  # exceptions of the shutdown are printed

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
