"""Cache folders of structure from motion, beside the photographs or in the user's cache, locked while in use."""

import atexit
import hashlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Literal

from bitymi_ns import files
from bitymi_ns.capture.types import CaptureError
from bitymi_ns.files import Tell, write_file
from bitymi_ns.reading import read_json
from bitymi_ns.trust import Refused, check_no_links, is_own, own_folder

FOLDER = ".bitymi"
OF = "of.json"  # file in a work folder with the source and the key of its content
Kind = Literal["poses", "points", "frames"]
"""First part of the name of a work folder: poses, points of known poses, or frames of a video with known poses."""
IN_USE = ".in-use-"  # prefix of the locks of processes that read from a work folder
VERSION = 5  # increased where the same photographs and options give other poses than before, to invalidate cached ones


def content_key(inputs: Iterable[tuple[str, Path]], settings: object) -> str:
    """Hash files, each with its name in the capture, and settings (plain values) to a key. Names, sizes and times of
    change count; how the paths are written does not."""
    stats = [(name, path.stat()) for name, path in inputs]
    content = [VERSION, [(name, stat.st_size, stat.st_mtime_ns) for name, stat in stats], settings]
    return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]


@contextmanager
def work_folder(photographs: Path, key: str, tell: Tell, kind: Kind = "poses") -> Iterator[Path]:
    """Make and lock the folder of this key for one process: in `.bitymi` beside the photographs (or a video), or in the
    user's cache folder where nothing can be written there, or others can write there, which `tell` reports.

    Raises:
        CaptureError: another process is at work there, or neither can be written.
    """
    beside, cache = home(photographs), user_cache()
    problem: OSError | None = None
    for root in (beside, cache):
        if root is None:
            continue
        folder = root / f"{kind}-{key}"
        try:
            root.parent.mkdir(parents=True, exist_ok=True)
            own_folder(root, close=True)
            own_folder(folder)
            check_no_links(folder.iterdir())
            lock = files.Lock(folder / ".lock", tell=lambda text: None)
        except files.Busy as error:
            raise CaptureError(f"{kind} of {photographs} are being found already: {error}") from error
        except OSError as error:
            if root == beside and isinstance(error, Refused):
                tell(f"{error}. It is not used: the {kind} are kept in {cache or 'no place that is known'}.")
            problem = error
            continue
        with lock:
            yield folder
        return
    assert problem is not None
    raise CaptureError(
        f"neither {beside} nor {cache or 'a cache folder'} can be written ({files.reason(problem, cache or beside)}): "
        "set XDG_CACHE_HOME to a folder on a disk with space"
    )


def home(photographs: Path) -> Path:
    """The folder beside photographs or a video for what is found of them; the same one, whether a capture is named or
    its folder `images`. Beside a mount point it would not stay with the photographs."""
    folder = Path(os.path.abspath(photographs if photographs.is_dir() else photographs.parent))
    return (folder.parent if folder.name == "images" and not os.path.ismount(folder) else folder) / FOLDER


def finished(photographs: Path, key: str, mark: str, kind: Kind = "poses") -> Path | None:
    """The folder of this key in which a file of this name says that the work is done; None = there is none that others
    cannot write to."""
    for root in (home(photographs), user_cache()):
        if root is not None and is_own(root) and is_own(folder := root / f"{kind}-{key}"):
            with suppress(OSError):
                check_no_links(folder.iterdir())
                if (folder / mark).is_file():
                    return folder
    return None


def replace_stale(work: Path, photographs: Path, contents: str) -> None:
    """State the source of a work folder, which this process holds, and remove folders of an earlier state of that
    source: their key cannot recur. Those with other options stay, because runs were trained on them; so do those that a
    process uses. `contents` is the key of the files alone."""
    source = os.path.relpath(os.path.realpath(photographs), os.path.realpath(work))  # still so when both are moved
    write_file(work / OF, json.dumps({"source": source, "contents": contents}).encode())
    for other in work.parent.glob(f"{work.name.partition('-')[0]}-*"):
        if other != work and _is_stale(other, source, contents):
            try:
                with files.Lock(other / ".lock", tell=lambda text: None):
                    shutil.rmtree(other, ignore_errors=True)
            except (files.Busy, OSError):
                continue


def _is_stale(other: Path, source: str, contents: str) -> bool:
    if not is_own(other):
        return False
    try:
        of = read_json(other / OF)
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


def keep_work_folder(work: Path) -> None:
    """Keep other processes from removing a work folder until this one ends."""
    with suppress(files.Busy, OSError):  # a folder that cannot be written is not removed either
        mark = work / f"{IN_USE}{os.getpid()}"
        files.hold(mark, lambda text: None)
        atexit.register(files.release, mark)


def user_cache() -> Path | None:
    """Return the user's cache folder; None where it is unknown."""
    with suppress(RuntimeError):  # there is no HOME, and the system does not know the user
        stated = os.environ.get("XDG_CACHE_HOME", "")
        return (Path(stated) if os.path.isabs(stated) else Path.home() / ".cache") / "bitymi-ns"
    return None
