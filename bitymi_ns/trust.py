"""Protection against files of others: links are not followed, folders that others can write to are not used, names stay
inside a folder, JSON within a nesting depth, text is printable, and Python runs no module of the current folder."""

import errno
import json
import os
import re
import stat
import sys
from collections.abc import Iterable, Sequence
from contextlib import suppress
from pathlib import Path, PurePosixPath
from typing import Any

UNFINISHED = ".unfinished"  # ends the name of a file on its way, which begins with a dot: a killed process leaves it
LONGEST = 1000  # letters of a name that are shown
DEEPEST = 100  # levels of JSON that are read
_CALL = "import sys; sys.path[:] = [folder for folder in sys.path if folder]; from {0} import {1}; sys.exit({1}())"
_CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


class Refused(PermissionError):
    """A file or folder may have been put there by somebody else; the message says what to do."""

    def __init__(self, message: str, path: Path) -> None:
        super().__init__(errno.EPERM, message, str(path))

    def __str__(self) -> str:
        return self.strerror


def no_links(name: str | os.PathLike[str], flags: int) -> int:
    """Open a file for writing, made where it is missing; to be given to `open` as its opener.

    Raises:
        Refused: it is a link, or has another name elsewhere, or is no file; or it is of somebody to whom the folder
            does not belong either.
        OSError: it cannot be opened.
    """
    path = Path(name)
    empty = flags & os.O_TRUNC
    flags = (flags | os.O_NOFOLLOW) & ~(os.O_CREAT | os.O_EXCL | os.O_TRUNC)
    while True:
        try:
            return os.open(path, flags | os.O_CREAT | os.O_EXCL, 0o666)
        except FileExistsError:
            pass
        try:
            file = os.open(path, flags | os.O_NONBLOCK)  # which does not wait for the other end of a pipe
            break
        except FileNotFoundError:  # it has been removed in the meantime
            continue
        except OSError as error:
            if path.is_symlink():
                raise Refused(f"{path} is a link, which is not followed: remove it", path) from error
            raise
    try:
        _check(path, os.fstat(file))
        os.set_blocking(file, True)
        if empty:
            os.ftruncate(file, 0)
    except BaseException:
        os.close(file)
        raise
    return file


def _check(path: Path, found: os.stat_result) -> None:
    if not stat.S_ISREG(found.st_mode):
        raise Refused(f"{path} exists and is not a regular file: remove it", path)
    if found.st_nlink > 1:
        raise Refused(f"{path} is also the file of another name (a hard link): remove it", path)
    _check_owner(path, found)


def _check_owner(path: Path, found: os.stat_result) -> None:
    """Refuse files of anybody but the user and the owner of the folder, who could replace them at any time."""
    if found.st_uid not in (os.geteuid(), os.stat(path.parent).st_uid):
        raise Refused(f"{path} belongs to another user: have it removed, or choose another path", path)


def is_left(folder: Path) -> bool:
    """Test for a folder that a killed process may have left.

    Raises:
        Refused: something else is there, or somebody else's.
    """
    try:
        found = os.lstat(folder)
    except FileNotFoundError:
        return False
    if not stat.S_ISDIR(found.st_mode):
        raise Refused(f"{folder} exists and is not a folder: remove it", folder)
    _check_owner(folder, found)
    return True


def own_folder(folder: Path, close: bool = False) -> None:
    """Make a folder that only the user can write to, where it is missing.

    Args:
        folder: its parent is not checked.
        close: remove write permission of others from an existing folder, whose content does not matter.

    Raises:
        Refused: what is there belongs to another user, can be written by others, or is a link.
        OSError: it cannot be made.
    """
    with suppress(FileExistsError):
        folder.mkdir(mode=0o755)
        close = True  # an access list of the parent may have given more rights
    with suppress(OSError):
        found = os.lstat(folder)
        if close and stat.S_ISDIR(found.st_mode) and found.st_mode & 0o022 and found.st_uid == os.geteuid():
            os.chmod(folder, stat.S_IMODE(found.st_mode) & ~0o022)
    if not is_own(folder):
        raise Refused(f"{folder} belongs to another user, or others can write to it, or it is a link", folder)


def is_own(folder: Path) -> bool:
    """Test for a folder, not a link to one, that belongs to the user and that nobody else can write to."""
    try:
        found = os.lstat(folder)
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and not found.st_mode & 0o022


def check_no_links(paths: Iterable[Path]) -> None:
    """Check that none of these paths, which may be missing, is a symbolic or hard link; archives can contain both.

    Raises:
        Refused: one is.
    """
    for path in paths:
        try:
            found = os.lstat(path)
        except FileNotFoundError:
            continue
        if stat.S_ISLNK(found.st_mode) or (stat.S_ISREG(found.st_mode) and found.st_nlink > 1):
            raise Refused(f"{path} is a link, which is not followed: remove it", path)


def strangers(folder: Path, made: Iterable[str]) -> list[str]:
    """List files and folders in a folder that are not among those made by its writer, relative to it.

    Args:
        made: names of all files that were made, relative to it.
    """
    named = [PurePosixPath(name) for name in made]
    files = {str(path) for name in named for path in (name, name.with_name(f".{name.name}{UNFINISHED}"))}
    folders = {str(parent) for name in files for parent in PurePosixPath(name).parents}
    found = []
    for parent, below, names in os.walk(folder):
        where = Path(parent).relative_to(folder)
        for name in [*below, *names]:
            path = (where / name).as_posix()
            links = (folder / path).is_symlink()
            if links or path not in (files if name in names else folders):
                found.append(path)
        below[:] = [name for name in below if (where / name).as_posix() in folders]
    return sorted(found)


def keep(folder: Path, made: Iterable[str]) -> None:
    """Check that a folder holds nothing that would be lost if it was replaced.

    Raises:
        Refused: it does.
    """
    others = strangers(folder, made)
    if others:
        lost = f"{folder} also holds {listed(others)}, which would be lost"
        raise Refused(f"{lost}: move that away, or choose another folder", folder)


def inside(folder: Path, name: str) -> Path:
    """Join a folder and a relative name.

    Raises:
        ValueError: the name leads out of the folder, or is empty.
    """
    if not leads_inside(name):
        raise ValueError(f"the name {name!r} leads elsewhere than to a file in the folder: correct it")
    return folder / PurePosixPath(name)


def leads_inside(name: str) -> bool:
    """Test that a relative name stays inside the folder that it is relative to."""
    path = PurePosixPath(name)
    return bool(path.parts) and not path.is_absolute() and ".." not in path.parts and "\0" not in name


def json_of(data: str | bytes) -> Any:
    """Parse untrusted JSON.

    Raises:
        ValueError: it is no JSON, or is nested too deeply to process.
    """
    try:
        value = json.loads(data)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    level = [value]
    for _ in range(DEEPEST):
        level = [
            child
            for each in level
            if isinstance(each, (list, dict))
            for child in (each.values() if isinstance(each, dict) else each)
        ]
        if not level:
            return value
    raise ValueError("it is nested too deeply")


def printable(text: str) -> str:
    """Escape control characters, changes of writing direction and surrogates for a terminal; file names may hold
    them."""
    return _CONTROLS.sub(lambda found: found.group().encode("unicode_escape").decode(), text)


def listed(names: Sequence[object], most: int = 3) -> str:
    """The first few names, at most LONGEST letters of each, and how many more there are."""
    shown = ", ".join(str(name)[:LONGEST] for name in names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def is_text(name: str | os.PathLike[str]) -> bool:
    """Test if a file's name is UTF-8, as most files that name it need."""
    try:
        os.fspath(name).encode()
    except UnicodeEncodeError:
        return False
    return True


def python_command(module: str, function: str) -> list[str]:
    """The command that calls a function of a module in a new process of this Python, without arguments; the function
    returns the exit code, as that of a console script does. Further words of the command are in `sys.argv`.

    The current folder is not on its search path, as it would be with `-m` or `-c` alone: it may be a capture of
    somebody else, and a `json.py` in it would be run. `-P` does the same, but Python 3.10 does not know it; `-I` does
    more, so that the user's own packages would not be found.
    """
    return [sys.executable, "-c", _CALL.format(module, function)]
