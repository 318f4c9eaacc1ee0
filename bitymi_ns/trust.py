"""Protection against untrusted files, names and JSON, and against modules in the current folder."""

import errno
import json
import os
import re
import stat
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from contextlib import suppress
from itertools import chain
from pathlib import Path, PurePosixPath
from typing import Any

UNFINISHED = ".unfinished"  # suffix of files being written, and left by killed processes
LONGEST = 1000  # most characters of a name in messages
DEEPEST = 100  # most nesting of JSON
_CALL = "import sys; sys.path[:] = [folder for folder in sys.path if folder]; from {0} import {1}; sys.exit({1}())"
_CONTROLS = re.compile("[\x00-\x08\x0b-\x1f\x7f-\x9f\u2028-\u202e\u2066-\u2069\ud800-\udfff]")


class Refused(PermissionError):
    """A file or folder may belong to somebody else; the message says what to do."""

    def __init__(self, message: str, path: Path) -> None:
        super().__init__(errno.EPERM, message, str(path))

    def __str__(self) -> str:
        return str(self.strerror)


def no_links(name: str | os.PathLike[str], flags: int) -> int:
    """Open or create a file for writing, as an opener for `open`. Raises Refused: it is a symbolic or hard link, is no
    regular file, or belongs neither to the user nor to the folder's owner."""
    path = Path(name)
    how = (flags | os.O_NOFOLLOW) & ~(os.O_CREAT | os.O_EXCL | os.O_TRUNC)
    while True:
        try:
            return os.open(path, how | os.O_CREAT | os.O_EXCL, 0o666)  # of any owner that the file system gives it
        except FileExistsError:
            pass
        try:
            file = os.open(path, how | os.O_NONBLOCK)  # does not block on a pipe
            break
        except FileNotFoundError:  # removed in the meantime
            continue
        except OSError as error:
            if path.is_symlink():
                raise Refused(f"{path} is a link, which is not followed: remove it", path) from error
            raise
    try:
        found = os.fstat(file)
        if not stat.S_ISREG(found.st_mode):
            raise Refused(f"{path} exists and is not a regular file: remove it", path)
        if found.st_nlink > 1:
            raise Refused(f"{path} is also the file of another name (a hard link): remove it", path)
        _check_owner(path, found)
        os.set_blocking(file, True)
        if flags & os.O_TRUNC:
            os.ftruncate(file, 0)
    except BaseException:
        os.close(file)
        raise
    return file


def _check_owner(path: Path, found: os.stat_result) -> None:
    """Refuse files of users other than this one and the folder's owner, who could replace them anyway."""
    if found.st_uid not in (os.geteuid(), os.stat(path.parent).st_uid):
        raise Refused(f"{path} belongs to another user: have it removed, or choose another path", path)


def is_left(folder: Path) -> bool:
    """Test for a folder that a killed process left. Raises Refused: it is no folder, or somebody else's."""
    try:
        found = os.lstat(folder)
    except FileNotFoundError:
        return False
    if not stat.S_ISDIR(found.st_mode):
        raise Refused(f"{folder} exists and is not a folder: remove it", folder)
    _check_owner(folder, found)
    return True


def own_folder(folder: Path, close: bool = False) -> None:
    """Create a folder, if missing, that only the user can write to; its parent is not checked. `close`: take write
    permission from others. Raises Refused: it is another user's, others can write to it, or it is a link."""
    with suppress(FileExistsError):
        folder.mkdir(mode=0o755)
        close = True  # an ACL of the parent may have granted more rights
    with suppress(OSError):
        found = os.lstat(folder)
        if close and stat.S_ISDIR(found.st_mode) and found.st_mode & 0o022 and found.st_uid == os.geteuid():
            os.chmod(folder, stat.S_IMODE(found.st_mode) & ~0o022)
    if not is_own(folder):
        raise Refused(f"{folder} belongs to another user, or others can write to it, or it is a link", folder)


def is_own(folder: Path) -> bool:
    """Test for a folder, not a link, that belongs to the user and only the user can write to."""
    try:
        found = os.lstat(folder)
    except OSError:
        return False
    return stat.S_ISDIR(found.st_mode) and found.st_uid == os.geteuid() and not found.st_mode & 0o022


def check_no_links(paths: Iterable[Path]) -> None:
    """Check that no path, if it exists, is a link, symbolic or hard, as archives can contain. Raises Refused."""
    for path in paths:
        try:
            found = os.lstat(path)
        except FileNotFoundError:
            continue
        if stat.S_ISLNK(found.st_mode) or (stat.S_ISREG(found.st_mode) and found.st_nlink > 1):
            raise Refused(f"{path} is a link, which is not followed: remove it", path)


def foreign_files(folder: Path, made: Iterable[str]) -> list[str]:
    """List files and folders in a folder that its writer, of the relative names `made`, did not create."""
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


def check_replaceable(
    folder: Path,
    what: str,
    made: Iterable[str] | None,
    overwrite: bool,
    refuse: Callable[[str], Exception],
    option: str = "--overwrite",
) -> None:
    """Check that a folder is missing or empty, or holds an earlier result alone, which may be replaced; else raise
    `refuse` of a message. `what`: such a result in messages, e.g. "a bundle"; `made`: names of all its files, read
    after the other checks (None = there is no such result); `option`: command-line option that sets `overwrite`."""
    if not os.path.lexists(folder) or (folder.is_dir() and not any(folder.iterdir())):
        return
    if not folder.is_dir():
        kind = "a link to nothing" if folder.is_symlink() and not folder.exists() else "not a folder"
        raise refuse(f"{folder} is {kind}: choose another folder")
    if made is None:
        raise refuse(f"{folder} is not {what} and is not replaced: choose another folder")
    if not overwrite:
        raise refuse(f"{folder} is there already: choose another folder, or add {option}")
    if others := foreign_files(folder, made):
        lost = f"{folder} also holds {listed(others)}, which would be lost"
        raise refuse(f"{lost}: move that away, or choose another folder")


def inside(folder: Path, name: str) -> Path:
    """Join a folder and a relative name. Raises ValueError: the name is empty or leaves the folder."""
    if not leads_inside(name):
        raise ValueError(f"the name {name!r} leads elsewhere than to a file in the folder: correct it")
    return folder / PurePosixPath(name)


def leads_inside(name: str) -> bool:
    """Test if a relative name stays inside its folder."""
    path = PurePosixPath(name)
    return bool(path.parts) and not path.is_absolute() and ".." not in path.parts and "\0" not in name


def finite_numbers(values: Mapping[str, Any]) -> dict[str, float]:
    numbers = {
        key: value for key, value in values.items() if isinstance(value, (int, float)) and not isinstance(value, bool)
    }
    return {key: float(value) for key, value in numbers.items() if abs(value) <= sys.float_info.max}


def json_of(data: str | bytes) -> Any:
    """Parse untrusted JSON. Raises ValueError: it is no JSON, or is nested too deeply."""
    try:
        value = json.loads(data)
    except RecursionError:
        raise ValueError("it is nested too deeply") from None
    level = [value]
    for _ in range(DEEPEST):
        parts = (part.values() if isinstance(part, dict) else part for part in level if isinstance(part, (list, dict)))
        level = list(chain.from_iterable(parts))
        if not level:
            return value
    raise ValueError("it is nested too deeply")


def printable(text: str) -> str:
    """Escape control characters, bidirectional controls and surrogates for a terminal."""
    return _CONTROLS.sub(lambda found: found.group().encode("unicode_escape").decode(), text)


def told_apart(paths: Sequence[Path]) -> list[str]:
    """Name files, with as many of the folders above them as tell all apart."""
    count = len(set(paths))
    for depth in range(1, max((len(path.parts) for path in paths), default=0) + 1):
        names = ["/".join(path.parts[-depth:]) for path in paths]
        if len(set(names)) == count:
            return names
    return [str(path) for path in paths]


def listed(names: Sequence[object], most: int = 3) -> str:
    """Join the first few names, truncated to LONGEST characters, and the number of further ones."""
    shown = ", ".join(str(name)[:LONGEST] for name in names[:most])
    return shown if len(names) <= most else f"{shown} and {len(names) - most} more"


def is_text(name: str | os.PathLike[str]) -> bool:
    """Test if a file's name can be encoded as UTF-8."""
    return not re.search("[\ud800-\udfff]", os.fspath(name))


def python_command(module: str, function: str) -> list[str]:
    """Build a command that calls a function in a new process of this Python; the function returns the exit status, and
    further words of the command are in `sys.argv`. The current folder, which may be an untrusted capture, is removed
    from the search path: with `-m` or `-c` alone a `json.py` in it would be run. `-P` does the same, but Python 3.10
    lacks it; `-I` would also hide the user's own packages."""
    return [sys.executable, "-c", _CALL.format(module, function)]
