"""Table of what files and folders of a capture are: kinds.yaml, which `folder_contents.py` applies."""

from dataclasses import dataclass
from pathlib import Path

import yaml

PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".heic", ".heif", ".avif", ".jp2")
VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts", ".m2ts", ".3gp")
RENDERED = b"rendered by bitymi-ns"  # Comment in pictures and films of ns-render


@dataclass(frozen=True)
class Kind:
    """Name files or folders, and say what they are."""

    names: str  # Patterns in lower case; NAME stands for the name of a photograph or folder.
    what: str  # in messages
    of: str = ""  # patterns, one of which lies beside it
    use: str = ""  # how to use it, in messages
    mark: str = ""  # that the file holds


with open(Path(__file__).with_suffix(".yaml"), encoding="utf8") as _file:
    _rows = yaml.load(_file, getattr(yaml, "CSafeLoader", yaml.SafeLoader))  # in C ten times as fast
_TABLE = {name: tuple(Kind(**row) for row in rows) for name, rows in _rows.items()}
PICTURES, FOLDERS, OF_MASKS = (_TABLE[name] for name in ("PICTURES", "FOLDERS", "OF_MASKS"))
DYNAMIC, MASK, _ = OF_MASKS
RESULTS, UNREAD, OTHERS, POSES = (_TABLE[name] for name in ("RESULTS", "UNREAD", "OTHERS", "POSES"))
BUNDLE, RUN, _, _, RENDERS = RESULTS
IMAGES_OF, CLOUDS, LISTS = (_TABLE[name] for name in ("IMAGES_OF", "CLOUDS", "LISTS"))
NSVF, PROCESSED, SCANS = (_TABLE[name] for name in ("NSVF", "PROCESSED", "SCANS"))
FILM = Kind("", "a film of ns-render")
SPLITS = ("train", "val", "test", "train+test")  # folders of ns-render, in which RENDERS marks it
