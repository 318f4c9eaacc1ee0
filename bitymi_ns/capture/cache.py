"""Where the poses of a capture are kept while they are found and afterwards."""

from __future__ import annotations

import atexit
import hashlib
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

from bitymi_ns import files
from bitymi_ns.capture.types import CaptureError
from bitymi_ns.files import write_file

FOLDER = ".bitymi"
OF = "of.json"
"""File in a work folder: what it is of, and the key of that alone."""
IN_USE = ".in-use-"
"""Begins the names of the locks of processes that read what a work folder holds."""
VERSION = 4
"""Raised where the same photographs and options give other poses than before, so that kept ones are found anew."""


def content_key(paths: Sequence[Path], settings: object) -> str:
    """A key of the files' names, sizes and times of change, and of all that decides what is made of them."""
    stats = [(str(path), path.stat()) for path in paths]
    content = [VERSION, [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats], settings]
    return hashlib.sha256(json.dumps(content, sort_keys=True, default=str).encode()).hexdigest()[:16]


@contextmanager
def work_folder(source: Path, key: str) -> Iterator[Path]:
    """The folder of this key, held for one process, made where it is missing: `.bitymi` beside what the poses are found
    of, or the user's cache folder where nothing can be written there.

    Raises:
        CaptureError: another process is at work there, or neither can be written.
    """
    beside = (source if source.is_dir() else source.parent) / FOLDER
    name = f"poses-{key}"
    problem: OSError | None = None
    for home in (beside, user_cache()):
        folder = home / name
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock = files.Lock(folder / ".lock", tell=lambda text: None)
        except files.Busy as error:
            raise CaptureError(f"poses of {source} are being found already: {error}") from error
        except OSError as error:
            problem = error
            continue
        with lock:
            yield folder
        return
    assert problem is not None
    raise CaptureError(
        f"neither {beside} nor {user_cache()} can be written ({files.reason(problem, user_cache())}): "
        "set XDG_CACHE_HOME to a folder on a disk with space"
    )


def finished(source: Path, key: str, mark: str) -> Path | None:
    """The folder of this key in which a file of this name says that the work is done; None = there is none."""
    homes = ((source if source.is_dir() else source.parent) / FOLDER, user_cache())
    return next((folder for home in homes if ((folder := home / f"poses-{key}") / mark).is_file()), None)


def take_place(work: Path, source: Path, contents: str) -> None:
    """Say what a work folder is of, and remove those of the same source as it was before: their key cannot come back.
    Those with other options stay, because runs were trained on them; so do those that a process works in or reads from.

    Args:
        work: held by this process.
        source: photographs or a video.
        contents: the key of the files alone.
    """
    write_file(work / OF, json.dumps({"source": str(source.resolve()), "contents": contents}).encode())
    for other in work.parent.glob("poses-*"):
        if other != work and _is_stale(other, str(source.resolve()), contents):
            try:
                with files.Lock(other / ".lock", tell=lambda text: None):
                    shutil.rmtree(other, ignore_errors=True)
            except (files.Busy, OSError):
                continue


def _is_stale(other: Path, source: str, contents: str) -> bool:
    try:
        of = json.loads((other / OF).read_text("utf8"))
        if of["source"] != source or of["contents"] == contents:
            return False
    except (OSError, ValueError, LookupError, TypeError):
        return False
    for mark in other.glob(f"{IN_USE}*"):
        try:
            files.Lock(mark, tell=lambda text: None).release()
        except (files.Busy, OSError):
            return False
    return True


def read_from(work: Path) -> None:
    """Keep a work folder until this process ends: no other one removes it."""
    with suppress(files.Busy, OSError):  # a folder that cannot be written is not removed either
        mark = work / f"{IN_USE}{os.getpid()}"
        files.hold(mark, lambda text: None)
        atexit.register(files.release, mark)


def user_cache() -> Path:
    """The user's folder for what can be made again."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "bitymi-ns"
