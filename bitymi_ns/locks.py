"""Lock files, which the kernel releases when their process ends."""

from __future__ import annotations

import errno
import fcntl
import os
import socket
import threading
import warnings
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import BinaryIO

from .trust import no_links

Tell = Callable[[str], None]


class Busy(BlockingIOError):
    """Another process writes the same file or folder; `who` names it, if known, and says what to do."""

    def __init__(self, who: str) -> None:
        super().__init__(errno.EAGAIN, who)
        self.who = who

    def __str__(self) -> str:
        return self.who


def open_locked(path: Path) -> tuple[BinaryIO, bool]:
    """Open or create a file for writing, and lock it until all processes that have it open close it. Return the file,
    and False if the file system has no locks. Raises BlockingIOError: another process has it; OSError: it cannot be
    opened, or is refused by `no_links`."""
    while True:
        file = open(path, "r+b", opener=no_links)
        try:
            fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            file.close()
            raise
        except OSError:
            return file, False
        with suppress(FileNotFoundError):
            if os.path.samestat(os.fstat(file.fileno()), os.lstat(path)):
                return file, True
        file.close()  # removed or renamed meanwhile


class Lock:
    """Lock file of one process, with its number for the message to others. It is removed on release; that of a killed
    process does not block."""

    def __init__(self, path: Path, tell: Tell = warnings.warn) -> None:
        """Lock the file `path`, whose folder must exist. `tell`: called if the file system has no locks. Raises Busy:
        another process holds it; OSError: the file cannot be created."""
        self.path, self._owner = path, os.getpid()
        try:
            self._file, locked = open_locked(path)
        except BlockingIOError:
            raise Busy(_holder(path)) from None
        if not locked:
            tell(f"{path.parent} is on a file system without locks: see that no other process writes there.")
        self.name(self._owner)

    def name(self, process: int) -> None:
        """Write the working process's number to the file, if possible."""
        with suppress(OSError):
            self._file.seek(0)
            self._file.truncate()
            self._file.write(f"{process} {socket.gethostname()}\n".encode())
            self._file.flush()

    def fileno(self) -> int:
        """Return the descriptor that holds the lock; a child that inherits it also holds the lock."""
        return self._file.fileno()

    def release(self) -> None:
        """Release the lock; a second call, or one in a forked child, does nothing."""
        if not self._file.closed and self._owner == os.getpid():
            with suppress(OSError):
                self.path.unlink()
            with suppress(OSError):
                self._file.close()

    def __enter__(self) -> Lock:
        return self

    def __exit__(self, *error: object) -> None:
        self.release()


def _holder(path: Path) -> str:
    """Describe the holder of a lock, and what to do."""
    try:
        process, host = path.read_text("utf8").split()
    except (OSError, ValueError):  # just released, or not yet named
        return "another process is writing there: wait for it, or end it"
    where = "" if host == socket.gethostname() else f" on {host}"
    return f"process {process}{where} is writing there: wait for it, or end it (kill {process})"


held: dict[tuple[str, int], Lock] = {}  # by file and thread, to make them reentrant


def hold(path: Path, tell: Tell = warnings.warn) -> None:
    """Acquire the lock on a file, unless this thread has it already; see `Lock`."""
    key = (os.path.realpath(path), threading.get_ident())
    if key not in held:
        held[key] = Lock(path, tell)


def release(path: Path) -> None:
    lock = held.pop((os.path.realpath(path), threading.get_ident()), None)
    if lock is not None:
        lock.release()
