"""Atomic writes of files and folders, and explanations of failed writes.

Files are written as `.NAME.unfinished`, folders as `.NAME.new`, flushed, then renamed; a replaced folder is `.NAME.old`
in between. Writers hold a lock. The names are fixed, so that the next writer finds the remains of a killed process, and
restores or removes them."""

from __future__ import annotations

import errno
import os
import shutil
import threading
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import BinaryIO

from rich.filesize import decimal

from .locks import Busy, Tell, held, hold, open_locked, release
from .trust import UNFINISHED, Refused, is_left

_REASONS = {
    errno.EROFS: "the file system is read-only: write to another one",
    errno.EACCES: "you have no permission to write there: choose another folder, or change its permissions",
    errno.EPERM: "the system does not permit it, as after `chattr +i` (see `lsattr`): choose another name or folder",
    errno.ENOSPC: "the disk is full: free some space, or write to another disk",
    errno.EDQUOT: "your quota of disk space is used up: free some space, or write to another disk",
    errno.EFBIG: "the file would be larger than this system allows (see `ulimit -f`)",
    errno.ENAMETOOLONG: "the name is too long: choose a shorter one",
    errno.EISDIR: "it is a folder, not a file: choose another name",
    errno.ELOOP: "a link in its path leads back to itself: choose another path",
    errno.EBUSY: "it is in use by the system, as a mount point is: choose a folder in it",
    errno.EXDEV: "it lies in a lower layer of an overlay, as an image's folders in a container do: choose another name",
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
            what = "a link to nothing" if there.is_symlink() and not there.exists() else "not a folder"
            return f"{there} is {what}: choose another path"
        return f"nothing can be made in {there} ({error.strerror}): choose another folder"
    return _REASONS.get(error.errno or 0) or error.strerror or str(error)


@contextmanager
def write_errors_as(path: Path, kind: type[BaseException], then: str = "") -> Iterator[None]:
    """Convert OSErrors to exceptions of type `kind` that explain why `path` cannot be written; `then` is appended to
    the message. Errors that name a file elsewhere pass."""
    try:
        yield
    except OSError as error:
        if error.errno is None or not _concerns(error.filename, path):
            raise
        raise kind(f"{path} cannot be written: {reason(error, path)}{then}") from error


def _concerns(name: object, path: Path) -> bool:
    """Test if an error's file is in the way of writing `path`, belongs to the result, or is unknown."""
    if not isinstance(name, (str, os.PathLike)):
        return True
    near, place = Path(os.path.realpath(name)), Path(os.path.realpath(path))
    if near in (place, *place.parents):
        return True
    beside = near.parts[len(place.parent.parts)] if near.is_relative_to(place.parent) else ""
    return beside == place.name or beside.startswith(f".{place.name}.")


size_text = decimal  # a number of bytes in decimal units


def free_bytes(path: Path) -> int:
    """Return the free space for a file or folder, which need not exist."""
    return shutil.disk_usage(_nearest(path.absolute())).free


def _nearest(path: Path) -> Path:
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


@contextmanager
def reserved(target: str | Path, check: Callable[[], None] | None = None, tell: Tell = warnings.warn) -> Iterator[Path]:
    """Lock the path of a file or folder, and repair the remains of a killed process there; yield it with links
    resolved. Missing parents are created, and removed if they remain empty. One thread may nest reservations.

    `check`: for a folder: raises if the existing one may not be replaced; None: the target is a file. `tell`: called if
    the file system has no locks. Raises Busy: another process is writing it; OSError: nothing can be written there, or
    it is a folder instead of a file, or the reverse; `reason` says why."""
    place = Path(os.path.realpath(target))
    kind = errno.EBUSY if os.path.ismount(place) else 0
    if not kind and os.path.lexists(target) and place.is_dir() != (check is not None):
        kind = errno.EISDIR if check is None else errno.ENOTDIR
    if kind:
        raise OSError(kind, os.strerror(kind), str(place))
    lock = place.with_name(f".{place.name}.lock")
    outermost = (str(lock), threading.get_ident()) not in held
    with parents_of(place):
        hold(lock, tell)
        try:
            _recover(place)
            if check is not None:
                check()
            if outermost and os.path.lexists(place):
                _check_movable(place)
            yield place
        finally:
            if outermost:
                release(lock)


def _check_movable(place: Path) -> None:
    """Check that what is there can be replaced, which attributes or an overlay's lower layer can prevent. A folder is
    not moved: no file system renames it onto one that holds something."""
    if not place.is_dir():
        try:
            os.close(os.open(place, os.O_WRONLY | os.O_NONBLOCK))
        except OSError as error:
            if error.errno == errno.EPERM:  # others do not prevent that it is replaced
                raise
        return
    new, _ = _temporary_paths(place)
    try:
        new.mkdir()
        (new / "something").mkdir()
        place.rename(new)
    except OSError as error:
        if error.errno not in (errno.ENOTEMPTY, errno.EEXIST):
            raise
    finally:
        for path in (new / "something", new):
            with suppress(FileNotFoundError):
                path.rmdir()


def check_writable(target: Path) -> None:
    """Check in advance that a file can be written; raises as `reserved`."""
    if not _is_device(target):
        with reserved(target):
            pass


def check_folder(folder: Path) -> None:
    """Check in advance that files can be written into a folder; raises as `reserved`."""
    check_writable(folder / UNFINISHED)


def _is_device(path: Path) -> bool:
    """Test for a device or a pipe, such as /dev/stdout."""
    return path.exists() and not path.is_file() and not path.is_dir()


def _temporary_paths(place: Path) -> tuple[Path, Path]:
    return place.with_name(f".{place.name}.new"), place.with_name(f".{place.name}.old")


def _recover(place: Path) -> None:
    """Complete or undo an interrupted replacement: keep the new folder if complete, else restore the old one."""
    new, old = _temporary_paths(place)
    _remove(new)
    if is_left(old):
        if place.exists():
            old.rename(new)  # so that an .old is always complete
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
    """Create a temporary folder, which is yielded, and replaces the target if the block ends without an exception.

    Else the target is unchanged. After a kill it is the old or the new folder, or both are beside it until the next
    writer repairs that. `check`: raises if the existing target may not be replaced; called before and after the block.
    Raises as `reserved`."""
    with reserved(target, check, tell) as place:
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
def complete_file(path: Path, scratch: Path | None = None, follow: bool = False) -> Iterator[BinaryIO]:
    """Open a temporary file that replaces `path` if the block ends without an exception. `follow`: write through a
    link, for a path that the user gave; False: replace the link, for files of a folder that may come from others.
    `scratch`: folder on the same file system for the unfinished file; None: that of `path`. Raises Busy: another
    process is writing it; OSError: it cannot be written."""
    path = Path(os.path.realpath(path)) if follow else path
    unfinished = (scratch or path.parent) / f".{path.name}{UNFINISHED}"
    with parents_of(path):
        try:
            file, _ = open_locked(unfinished)
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
    """Copy a folder's files to a new one; unlike `shutil.copytree`, raise the first error at once."""
    to.mkdir(parents=True)
    for path in sorted(folder.iterdir()):
        if path.is_file():
            shutil.copyfile(path, to / path.name)


def write_file(path: Path, data: bytes, follow: bool = False) -> None:
    """Write a file by `complete_file`; devices and pipes directly."""
    if _is_device(path):
        path.write_bytes(data)
        return
    with complete_file(path, follow=follow) as file:
        file.write(data)


def remove_unfinished(folder: Path) -> None:
    """Remove unfinished files of ended processes, if possible."""
    for path in folder.glob(f".*{UNFINISHED}"):
        with suppress(OSError):
            file, locked = open_locked(path)
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
