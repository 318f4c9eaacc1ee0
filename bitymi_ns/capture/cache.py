"""Cache folders of structure from motion."""

import atexit
import hashlib
import json
import os
import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

from bitymi_ns import files, locks
from bitymi_ns.files import Tell, write_file
from bitymi_ns.safe_reading import read_json
from bitymi_ns.trust import Refused, check_no_links, is_own, own_folder
from .types import CaptureError, fail

FOLDER = ".bitymi"
OF = "of.json"  # file of a work folder's source and key
Kind = Literal["poses", "points", "frames"]
"""Content of a work folder, and the start of its name. A file "points" or "frames" marks these as complete."""
IN_USE = ".in-use-"  # prefix of the locks of reading processes
VERSION = 6  # increase when equal input gives other poses


def content_key(inputs: Iterable[tuple[str, Path]], settings: object) -> str:
    """Hash names, sizes and modification times of files, and plain values."""
    stats = [(name, path.stat()) for name, path in inputs]
    content = [VERSION, [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats], settings]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


@contextmanager
def work_folder(photographs: Path, key: str, tell: Tell, kind: Kind = "poses") -> Iterator[Path]:
    """Make and lock the folder of a key beside the photographs (or video), else in the user's cache folder. Raises
    CaptureError: another process works there, or neither can be written."""
    beside, cache = home(photographs), user_cache()
    problem: OSError | None = None
    for root in filter(None, (beside, cache)):
        folder = root / f"{kind}-{key}"
        try:
            root.parent.mkdir(parents=True, exist_ok=True)
            own_folder(root, close=True)
            own_folder(folder)
            check_no_links(folder.iterdir())
            lock = locks.Lock(folder / ".lock", tell=lambda text: None)
        except locks.Busy as error:
            fail(f"{kind} of {photographs} are being found already: {error}", error)
        except OSError as error:
            if root == beside and isinstance(error, Refused):
                tell(f"{error}. The {kind} are kept in {cache or 'no place that is known'} instead.")
            problem = error
            continue
        with lock:
            yield folder
        return
    assert problem is not None
    reason = files.reason(problem, cache or beside)
    fail(f"neither {beside} nor {cache or 'a cache folder'} can be written ({reason}): set XDG_CACHE_HOME to a folder")


def home(photographs: Path) -> Path:
    """Return the cache folder beside photographs, or beside their folder `images` unless that is a mount point."""
    folder = Path(os.path.abspath(photographs if photographs.is_dir() else photographs.parent))
    return (folder.parent if folder.name == "images" and not os.path.ismount(folder) else folder) / FOLDER


def made_once(photographs: Path, key: str, kind: Kind, tell: Tell, make: Callable[[Path], None]) -> Path:
    """Return the folder of this key, filled once by `make`; see `work_folder`."""
    for root in (home(photographs), user_cache()):
        if root is not None and is_own(root) and is_own(folder := root / f"{kind}-{key}"):
            with suppress(OSError):
                check_no_links(folder.iterdir())
                if (folder / kind).is_file():
                    return folder
    with work_folder(photographs, key, tell, kind) as work:
        if not (work / kind).is_file():
            with files.write_errors_as(work, CaptureError):
                make(work)
                write_file(work / kind, b"")
    return work


def replace_stale(work: Path, photographs: Path, contents: str) -> None:
    """Record the source of a work folder and the key of its files (`contents`), and remove the folders beside it of
    earlier contents. Those of other options, on which runs were trained, and those in use stay."""
    source = os.path.relpath(os.path.realpath(photographs), os.path.realpath(work))  # relative: both may move
    write_file(work / OF, json.dumps({"source": source, "contents": contents}).encode())
    for folder in work.parent.glob(f"{work.name.partition('-')[0]}-*"):
        # OSError: also if a process holds the lock
        with suppress(OSError, ValueError, LookupError, TypeError):
            record = folder != work and is_own(folder) and read_json(folder / OF)
            if record and record["source"] == source and record["contents"] != contents:
                for mark in folder.glob(f"{IN_USE}*"):
                    locks.Lock(mark, tell=lambda text: None).release()
                with locks.Lock(folder / ".lock", tell=lambda text: None):
                    shutil.rmtree(folder, ignore_errors=True)


def keep_work_folder(work: Path) -> None:
    """Keep other processes from removing a work folder while this one runs."""
    with suppress(OSError):  # a read-only folder is not removed either
        mark = work / f"{IN_USE}{os.getpid()}"
        locks.hold(mark, lambda text: None)
        atexit.register(locks.release, mark)


def emptied(folder: Path) -> Path:
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def user_cache() -> Path | None:
    """Return the user's cache folder; None = the system knows no home."""
    with suppress(RuntimeError):
        stated = os.environ.get("XDG_CACHE_HOME", "")
        return (Path(stated) if os.path.isabs(stated) else Path.home() / ".cache") / "bitymi-ns"
    return None
