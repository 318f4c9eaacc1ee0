"""Files and folders that appear whole or not at all, one writer at a time, and why something cannot be written.

Files are written as `.NAME.unfinished`, folders as `.NAME.new`, flushed, then renamed; a folder that is replaced is
`.NAME.old` meanwhile. Writers hold a lock, which the kernel releases however they end. The names are fixed, so that the
next writer finds what a killed process left, and puts it back or removes it."""

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
    """Another process writes the same file or folder; `who` names it, as far as it is known, and says what to do."""

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
    """Explain why `path` could not be written, and what to do; without a full stop."""
    if isinstance(error, (Busy, Refused)):
        return str(error)
    if error.errno in (errno.ENOTDIR, errno.EEXIST, errno.ENOENT):
        there = _nearest(path.absolute())
        if not there.is_dir():
            return f"{there} is not a folder: choose another path"
        return f"nothing can be made in {there} ({error.strerror}): choose another folder"
    return _REASONS.get(error.errno or 0) or error.strerror or str(error)


@contextmanager
def explained(path: Path, kind: type[BaseException], then: str = "") -> Iterator[None]:
    """Turn OSErrors in the block into exceptions of this kind that explain why `path` cannot be written; `then` ends
    their message."""
    try:
        yield
    except OSError as error:
        if error.errno is None:  # raised by this package, with a message of its own
            raise
        raise kind(f"{path} cannot be written: {reason(error, path)}{then}") from error


def free_bytes(path: Path) -> int:
    """Free space for a file or folder that may not be there yet, nor its parents."""
    return shutil.disk_usage(_nearest(path.absolute())).free


def size_text(size: int) -> str:
    """A number of bytes for people, in decimal units."""
    return decimal(size)


def _nearest(path: Path) -> Path:
    """The path, or the nearest of its parents that exists."""
    return next((p for p in (path, *path.parents) if os.path.lexists(p)), Path("/"))


@contextmanager
def parents_of(path: Path) -> Iterator[None]:
    """Make the missing parents of a path for the block, and remove those that are empty at its end."""
    made = [parent for parent in path.parents if not os.path.lexists(parent)]
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        yield
    finally:
        for parent in made:
            with suppress(OSError):
                parent.rmdir()


def _open_locked(path: Path) -> tuple[BinaryIO, bool]:
    """Open a file for writing, made where it is missing, and lock it until it is closed in all processes that have it.
    Returns the file, and whether it is locked: some network file systems know no locks.

    Raises:
        BlockingIOError: another process has the lock.
        OSError: it cannot be opened, or is not what it should be; see `no_links`."""
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
        file.close()  # its last holder has removed or renamed it in the meantime


class Lock:
    """A file that one process at a time holds. It has the number of that process, for the message to the others; it is
    removed when the lock is released, and a file that a killed process left is no hindrance."""

    def __init__(self, path: Path, tell: Tell = warnings.warn) -> None:
        """
        Args:
            path: the file; its folder must exist.
            tell: told where the file system has no locks; the lock then keeps nobody out.

        Raises:
            Busy: another process holds it.
            OSError: the file cannot be made.
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
        """State that this process does the work, for the message to others; a full disk costs only that."""
        with suppress(OSError):
            self._file.seek(0)
            self._file.truncate()
            self._file.write(f"{process} {socket.gethostname()}\n".encode())
            self._file.flush()

    def fileno(self) -> int:
        """The descriptor that holds the lock: a child that inherits it holds it, too."""
        return self._file.fileno()

    def release(self) -> None:
        """Let others have it; a second call, or one in a forked child, changes nothing."""
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
    except (OSError, ValueError):  # it has been released just now, or has not been named yet
        return "another process is writing there: wait for it, or end it"
    where = "" if host == socket.gethostname() else f" on {host}"
    return f"process {process}{where} is writing there: wait for it, or end it (kill {process})"


_held: dict[tuple[str, int], Lock] = {}  # locks by file and thread: who has one may take it again


def hold(path: Path, tell: Tell = warnings.warn) -> None:
    """Take the lock on this file, unless this thread has it already; see `Lock`."""
    key = (os.path.realpath(path), threading.get_ident())
    if key not in _held:
        _held[key] = Lock(path, tell)


def release(path: Path) -> None:
    """Release the lock that `hold` took, if there is one."""
    lock = _held.pop((os.path.realpath(path), threading.get_ident()), None)
    if lock is not None:
        lock.release()


@contextmanager
def reserved(target: str | Path, tell: Tell = warnings.warn) -> Iterator[Path]:
    """Lock the path of a file or folder, and repair what a killed process left of a folder there.

    Makes missing parents, and removes them again where they stay empty. As this writes beside the target, it also fails
    early where nothing can be written.

    Args:
        target: what is to be written in the block; reservations of one thread may be nested.
        tell: called where the file system has no locks.

    Yields:
        the target with links resolved.

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
            _settle(place)
            yield place
        finally:
            if outermost:
                release(lock)


def check_writable(target: Path) -> None:
    """Check that a file or folder can be written, before the work of making it; raises as `reserved` does."""
    if not _is_device(target):
        with reserved(target):
            pass


def _is_device(path: Path) -> bool:
    """Test for a device or a pipe, such as /dev/stdout."""
    return path.exists() and not path.is_file() and not path.is_dir()


def _beside(place: Path) -> tuple[Path, Path]:
    return place.with_name(f".{place.name}.new"), place.with_name(f".{place.name}.old")


def _settle(place: Path) -> None:
    """Complete or undo an interrupted replacement: the new folder if it was complete, else the old one. The caller
    holds the lock."""
    new, old = _beside(place)
    _remove(new)
    if is_left(old):
        if place.exists():
            old.rename(new)  # so that an .old is always whole, should this be the moment of a kill
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
    """Make a temporary folder that replaces the target when the block ends without an exception.

    On any exception, KeyboardInterrupt included, the target is as it was. After a kill it is the earlier folder or the
    later one, or both are beside it, and the next writer puts that right.

    Args:
        target: the folder; missing parents are made.
        check: raises if what is in the place may not be replaced; called before the block and after it.
        tell: called where the file system has no locks.

    Yields:
        the temporary folder.

    Raises:
        Busy: another process is writing it.
        OSError: it cannot be written; `reason` says why.
    """
    with reserved(target, tell) as place:
        check()
        new, old = _beside(place)
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
                _settle(place)


@contextmanager
def complete_file(path: Path, scratch: Path | None = None) -> Iterator[BinaryIO]:
    """Open a temporary file that replaces `path` when the block ends without an exception.

    Args:
        path: the file; missing parents are made.
        scratch: a folder of the same file system for the unfinished file; None = that of `path`.

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
            with suppress(OSError):  # what it still has in its buffer is of a write that failed
                file.close()
        flush(path.parent)


def copy_files(folder: Path, to: Path) -> None:
    """Copy the files of a folder to a new one; unlike `shutil.copytree`, this ends at the first error, and with it."""
    to.mkdir(parents=True)
    for path in sorted(folder.iterdir()):
        if path.is_file():
            shutil.copyfile(path, to / path.name)


def write_file(path: Path, data: bytes) -> None:
    """Write a file whole or not at all; see `complete_file`. Devices and pipes are written to as they are."""
    if _is_device(path):
        path.write_bytes(data)
        return
    with complete_file(path) as file:
        file.write(data)


def remove_unfinished(folder: Path) -> None:
    """Remove the unfinished files of processes that have ended; what cannot be removed stays."""
    for path in folder.glob(f".*{UNFINISHED}"):
        with suppress(OSError):
            file, locked = _open_locked(path)
            with file:
                if locked:
                    path.unlink()


def flush(path: Path) -> None:
    """Flush a file's bytes, or a folder's names, to disk; a full disk is reported here at the latest."""
    descriptor = os.open(path, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    except OSError:
        if not path.is_dir():  # not every file system can flush a folder
            raise
    finally:
        os.close(descriptor)
