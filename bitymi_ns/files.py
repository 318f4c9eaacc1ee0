"""Atomic writes of files and folders with locks, and explanations of failed writes.

Files are written as `.NAME.unfinished`, folders as `.NAME.new`, flushed, then renamed; a replaced folder is `.NAME.old`
in between. Writers hold a lock, which the kernel releases when they end. The names are fixed, so that the next writer
finds the remains of a killed process, and restores or removes them."""

from __future__ import annotations

import errno
import fcntl
import os
import shutil
import socket
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from rich.filesize import decimal

from bitymi_ns.trust import UNFINISHED, Refused, is_left, no_links

Tell = Callable[[str], None]  # receives a warning for the user


class Busy(BlockingIOError):
    """Error if another process writes the same file or folder; `who` names it, if known, and says what to do."""

    def __init__(self, who: str) -> None:
        super().__init__(errno.EAGAIN, who)
        self.who = who

    def __str__(self) -> str:
        return self.who


_REASONS = {
    errno.EROFS: "the file system is read-only: write to another one",
    errno.EACCES: "you have no permission to write there: choose another folder, or change its permissions",
    errno.EPERM: "the system does not permit writing there: choose another folder",
    errno.ENOSPC: "the disk is full: free some space, or write to another disk",
    errno.EDQUOT: "your quota of disk space is used up: free some space, or write to another disk",
    errno.EFBIG: "the file would be larger than this system allows (see `ulimit -f`)",
    errno.ENAMETOOLONG: "the name is too long: choose a shorter one",
    errno.EISDIR: "it is a folder, not a file: choose another name",
    errno.ELOOP: "a link in its path leads back to itself: choose another path",
    errno.EBUSY: "it is in use by the system, as a mount point is: choose a folder in it",
    errno.EXDEV: "it is a mount point: choose a folder in it",
    errno.EIO: "the disk reports an error of its own: check it, or write to another disk",
    errno.EMFILE: "too many files are open: allow more (see `ulimit -n`)",
    errno.ENFILE: "too many files are open on this machine: end other programs",
}


def reason(error: OSError, path: Path) -> str:
    """Explain why `path` could not be written and what to do, without a full stop."""
    if isinstance(error, (Busy, Refused)):
        return str(error)
    if error.errno in (errno.ENOTDIR, errno.EEXIST, errno.ENOENT):
        there = _nearest(path.absolute())
        if not there.is_dir():
            return f"{there} is not a folder: choose another path"
        return f"nothing can be made in {there} ({error.strerror}): choose another folder"
    return _REASONS.get(error.errno or 0) or error.strerror or str(error)


@contextmanager
def write_errors_as(path: Path, kind: type[BaseException], then: str = "") -> Iterator[None]:
    """Convert OSErrors in the block to exceptions of type `kind` that explain why `path` cannot be written; `then` is
    appended to the message."""
    try:
        yield
    except OSError as error:
        if error.errno is None:  # raised by this package, with its own message
            raise
        raise kind(f"{path} cannot be written: {reason(error, path)}{then}") from error


def free_bytes(path: Path) -> int:
    """Return the free space for a file or folder, which need not exist, nor its parents."""
    return shutil.disk_usage(_nearest(path.absolute())).free


def size_text(size: int) -> str:
    """Format a number of bytes in decimal units."""
    return decimal(size)


def _nearest(path: Path) -> Path:
    """Return the path or its nearest existing parent."""
    return next((p for p in (path, *path.parents) if os.path.lexists(p)), Path("/"))


@contextmanager
def parents_of(path: Path) -> Iterator[None]:
    """Create the missing parents of a path for the block, and remove those that are empty at its end."""
    made = [parent for parent in path.parents if not os.path.lexists(parent)]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for parent in made:
            with suppress(OSError):
                parent.rmdir()


def _open_locked(path: Path) -> tuple[BinaryIO, bool]:
    """Open or create a file for writing, and lock it until all processes that have it open close it. Returns the file,
    and True if it is locked; False if the file system does not support locks.

    Raises:
        BlockingIOError: another process has the lock.
        OSError: it cannot be opened, or is refused by `no_links`."""
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
        file.close()  # the previous holder has removed or renamed it in the meantime


class Lock:
    """Lock file of one process. It contains the process's number, for the message to others, and is removed on release;
    the file of a killed process does not block."""

    def __init__(self, path: Path, tell: Tell = warnings.warn) -> None:
        """
        Args:
            path: of the file; its folder must exist.
            tell: called if the file system has no locks; the lock is then ineffective.

        Raises:
            Busy: another process holds it.
            OSError: the file cannot be created.
        """
        self.path, self._owner = path, os.getpid()
        try:
            self._file, locked = _open_locked(path)
        except BlockingIOError:
            raise Busy(_holder(path)) from None
        if not locked:
            tell(f"{path.parent} is on a file system without locks: see that no other process writes there.")
        self.name(self._owner)

    def name(self, process: int) -> None:
        """Write the working process's number to the file, for the message to others; write errors are ignored."""
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


_held: dict[tuple[str, int], Lock] = {}  # locks by file and thread, to make them reentrant


def hold(path: Path, tell: Tell = warnings.warn) -> None:
    """Acquire the lock on a file, unless this thread has it already; see `Lock`."""
    key = (os.path.realpath(path), threading.get_ident())
    if key not in _held:
        _held[key] = Lock(path, tell)


def release(path: Path) -> None:
    """Release the lock of `hold`, if any."""
    lock = _held.pop((os.path.realpath(path), threading.get_ident()), None)
    if lock is not None:
        lock.release()


@contextmanager
def reserved(target: str | Path, tell: Tell = warnings.warn) -> Iterator[Path]:
    """Lock the path of a file or folder, and repair the remains of a killed process there.

    Creates missing parents, and removes those that remain empty. Since this writes beside the target, it fails early if
    nothing can be written there.

    Args:
        target: to be written in the block; reservations of one thread may be nested.
        tell: called if the file system has no locks.

    Yields:
        The target with links resolved.

    Raises:
        Busy: another process is writing it.
        OSError: nothing can be written there; `reason` says why.
    """
    place = Path(os.path.realpath(target))
    if os.path.ismount(place):
        raise OSError(errno.EBUSY, os.strerror(errno.EBUSY), str(place))
    lock = place.with_name(f".{place.name}.lock")
    outermost = (str(lock), threading.get_ident()) not in _held
    with parents_of(place):
        hold(lock, tell)
        try:
            _recover(place)
            yield place
        finally:
            if outermost:
                release(lock)


def check_writable(target: Path) -> None:
    """Check in advance that a file or folder can be written; raises what `reserved` raises."""
    if not _is_device(target):
        with reserved(target):
            pass


def _is_device(path: Path) -> bool:
    """Return True for a device or a pipe, such as /dev/stdout."""
    return path.exists() and not path.is_file() and not path.is_dir()


def _temporary_paths(place: Path) -> tuple[Path, Path]:
    return place.with_name(f".{place.name}.new"), place.with_name(f".{place.name}.old")


def _recover(place: Path) -> None:
    """Complete or undo an interrupted replacement: keep the new folder if complete, else restore the old one. The
    caller holds the lock."""
    new, old = _temporary_paths(place)
    _remove(new)
    if is_left(old):
        if place.exists():
            old.rename(new)  # so that an .old is always complete, even if killed during removal
            _remove(new)
        else:
            old.rename(place)


def _remove(folder: Path) -> None:
    if is_left(folder):
        shutil.rmtree(folder)


@contextmanager
def complete_folder(
    target: str | Path, check: Callable[[], None] = lambda: None, tell: Tell = warnings.warn
) -> Iterator[Path]:
    """Create a temporary folder that replaces the target if the block ends without an exception.

    After any exception, including KeyboardInterrupt, the target is unchanged. After a kill it is the old or the new
    folder, or both are beside it until the next writer repairs that.

    Args:
        target: the folder; missing parents are created.
        check: raises if the existing target may not be replaced; called before and after the block.
        tell: called if the file system has no locks.

    Yields:
        The temporary folder.

    Raises:
        Busy: another process is writing it.
        OSError: it cannot be written; `reason` says why.
    """
    with reserved(target, tell) as place:
        check()
        new, old = _temporary_paths(place)
        try:
            new.mkdir()
            yield new
            for path in new.rglob("*"):
                flush(path)
            flush(new)
            check()
            if place.exists():
                place.rename(old)
            new.rename(place)
            flush(place.parent)
        finally:
            with suppress(OSError):  # the next writer tries again
                _recover(place)


@contextmanager
def complete_file(path: Path, scratch: Path | None = None) -> Iterator[BinaryIO]:
    """Open a temporary file that replaces `path` if the block ends without an exception.

    Args:
        path: the file; missing parents are created.
        scratch: folder on the same file system for the unfinished file; None: that of `path`.

    Raises:
        Busy: another process is writing it.
        OSError: it cannot be written; `reason` says why.
    """
    unfinished = (scratch or path.parent) / f".{path.name}{UNFINISHED}"
    with parents_of(path):
        try:
            file, _ = _open_locked(unfinished)
        except BlockingIOError:
            raise Busy("another process is writing it: wait for it, or end it") from None
        try:
            file.truncate(0)
            yield file
            file.flush()
            os.fsync(file.fileno())
            os.replace(unfinished, path)
        except BaseException:
            with suppress(OSError):
                unfinished.unlink()
            raise
        finally:
            with suppress(OSError):  # the buffer may hold the rest of a failed write
                file.close()
        flush(path.parent)


def copy_files(folder: Path, to: Path) -> None:
    """Copy the files of a folder to a new one; unlike `shutil.copytree`, raises the first error at once."""
    to.mkdir(parents=True)
    for path in sorted(folder.iterdir()):
        if path.is_file():
            shutil.copyfile(path, to / path.name)


def write_file(path: Path, data: bytes) -> None:
    """Write a file atomically, see `complete_file`; devices and pipes are written directly."""
    if _is_device(path):
        path.write_bytes(data)
        return
    with complete_file(path) as file:
        file.write(data)


def remove_unfinished(folder: Path) -> None:
    """Remove unfinished files of ended processes; errors are ignored."""
    for path in folder.glob(f".*{UNFINISHED}"):
        with suppress(OSError):
            file, locked = _open_locked(path)
            with file:
                if locked:
                    path.unlink()


def flush(path: Path) -> None:
    """Flush a file or a folder's entries to disk; a full disk is reported here at the latest."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError:
        if not path.is_dir():  # some file systems cannot flush folders
            raise
    finally:
        os.close(descriptor)
