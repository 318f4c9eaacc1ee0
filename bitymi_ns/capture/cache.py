"""Where the poses of a capture are kept while they are found and afterwards."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

from bitymi_ns import files
from bitymi_ns.capture.types import CaptureError

FOLDER = ".bitymi"
VERSION = 2
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


def user_cache() -> Path:
    """The user's folder for what can be made again."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "bitymi-ns"
