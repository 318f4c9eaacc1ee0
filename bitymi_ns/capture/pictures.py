"""Photographs among the pictures of a folder, and what the others are."""

import os
import re
from collections import defaultdict
from collections.abc import Collection, Iterator
from pathlib import Path

import pillow_heif
from PIL import Image

from bitymi_ns.capture import ignored_files
from bitymi_ns.capture.results import is_capture, is_rendered_film, result_in
from bitymi_ns.reading import open_regular

pillow_heif.register_heif_opener()  # so that Pillow opens all of these, whoever asks it to

PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".webp", ".tif", ".tiff", ".bmp", ".heic", ".heif", ".avif", ".jp2")
FORMATS_OF_PICTURES = (
    "JPEG", "MPO", "PNG", "WEBP", "TIFF", "BMP", "HEIF", "AVIF", "JPEG2000", "GIF", "PPM", "TGA"
)  # fmt: skip
"""Formats of photographs and masks by Pillow's names, whatever the file name. EPS, among others, is excluded: it is a
program that Ghostscript runs."""
VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".mts", ".m2ts", ".3gp")
DYNAMIC_MASK = "dynamic_mask_"
"""Begins the name of the mask that instant-ngp reads beside a photograph: all that is not black does not count."""


def open_picture(file: Path) -> Image.Image:
    """Open a photograph or mask with Pillow; raises Pillow's errors, and those of `open_regular`."""
    open_regular(file).close()
    Image.init()  # Pillow knows AVIF from a version on
    return Image.open(file, formats=[name for name in FORMATS_OF_PICTURES if name in Image.OPEN])


def is_photograph(path: Path) -> bool:
    """Test for an image that is not a depth map, mask or thumbnail."""
    return is_picture(path) and not _no_photograph(path)


def is_picture(path: Path) -> bool:
    """Test for a file with the extension of a photograph that is not hidden."""
    return path.suffix.lower() in PHOTOGRAPHS and not path.name.startswith(".") and path.is_file()


def _no_photograph(path: Path) -> str:
    """Describe an image that is no photograph, by its name; empty = a photograph."""
    matching = (what for pattern, what in ignored_files.FILES.items() if re.fullmatch(pattern, path.stem.lower()))
    return next(matching, "")


def no_photographs(folder: Path, beside: Collection[str] = ()) -> str:
    """Describe the pictures in a folder that are no photographs, by its name, the names of folders `beside` it and the
    results in it; empty = there may be photographs."""
    known = "hidden" if folder.name.startswith(".") else ignored_files.FOLDERS.get(folder.name.lower())
    return known or _copies(folder.name, beside) or result_in(folder)


def _copies(name: str, beside: Collection[str]) -> str:
    """Describe the copies that a folder holds of images in a folder beside it, by its name; empty = none."""
    if f"corrected_{name}" in beside:
        return "raw copies of corrected pictures"
    original, _, factor = name.rpartition("_")
    return "reduced copies" if factor in ("2", "4", "8", "16") and original in beside else ""


def folders_in(folder: Path) -> list[Path]:
    """List the folders in a folder that may hold photographs."""
    names = [path.name for path in folder.iterdir() if path.is_dir()]
    return sorted(folder / name for name in names if not no_photographs(folder / name, names))


def has_photographs(folder: Path, below: bool = False) -> bool:
    """Test if photographs lie in a folder, or in or `below` it."""
    if not folder.is_dir():
        return False
    return any(True for _ in photographs_below(folder)) if below else any(map(is_photograph, folder.iterdir()))


def photographs_below(folder: Path) -> Iterator[Path]:
    """Yield the photographs in and below a folder, without hidden folders and those of other content."""
    for parent, below, names in os.walk(folder):
        below[:] = sorted(name for name, what in _skipped(Path(parent), below).items() if not what)
        yield from filter(is_photograph, (Path(parent, name) for name in names))


def videos_in(folder: Path, rendered: bool = False) -> list[Path]:
    """List the videos in a folder that are not hidden; `rendered`: the films that ns-render wrote instead."""
    names = (path for path in folder.iterdir() if path.suffix.lower() in VIDEOS and not path.name.startswith("."))
    return sorted(path for path in names if path.is_file() and is_rendered_film(path) is rendered)


def _skipped(parent: Path, below: Collection[str]) -> dict[str, str]:
    """Map the names of folders below a searched one to what is in them that is not searched; empty = it is. Captures
    beside photographs have copies of these."""
    found = {name: no_photographs(parent / name, below) for name in sorted(below)}
    captures = [name for name, what in found.items() if not what and is_capture(parent / name)]
    if captures and (has_photographs(parent) or has_photographs(parent / "images")):
        found |= dict.fromkeys(captures, "pictures of another capture")
    return found


def passed_over(folder: Path, used: Collection[Path] | None = None) -> list[str]:
    """Describe the pictures in and below a folder that are not read: those that `photographs_below` leaves out, and
    with the files that are `used`, the other photographs in folders with these and one level below."""
    found, holding = [], {above for path in used or () for above in path.parents}
    for parent, below, names in os.walk(folder):
        skipped = _skipped(Path(parent), below)
        for name, what in skipped.items():
            count = 0 if what in ("", "hidden") else _pictures(Path(parent, name), used or ())
            if count:
                found.append(f"{Path(parent, name).relative_to(folder)} ({count} {what})")
        searched = used is None or Path(parent) in holding  # a folder of captures may hold a whole disk
        below[:] = [name for name, what in skipped.items() if searched and not what]
        read, unnamed = [name for name in names if is_picture(Path(parent, name))], []
        alike: dict[str, list[Path]] = defaultdict(list)
        for path in (Path(parent, name) for name in sorted(read)):
            if used is not None and path in used:
                continue
            if what := _no_photograph(path):
                alike[what].append(path.relative_to(folder))
            elif used is not None:
                unnamed.append(path.name)
        for what, paths in alike.items():
            more = f" and {len(paths) - 1} more" if len(paths) > 1 else ""
            found.append(f"{paths[0]}{more} ({what})")
        if unnamed:
            few = ", ".join(unnamed[:2]) + (", ..." if len(unnamed) > 2 else "")
            found.append(f"{len(unnamed)} pictures of {parent} that nothing names ({few})")
        films = videos_in(Path(parent), rendered=True)
        found += [f"{film.relative_to(folder)} (a film of ns-render)" for film in films]
        for ending, count in ignored_files.pictures_among(names, read).items():
            found.append(f"{count} {ending} of {parent} ({ignored_files.PICTURES[ending]}, which is not read)")
    return found


def _pictures(folder: Path, used: Collection[Path]) -> int:
    """Count the pictures in and below a folder that are not used."""
    walked = (Path(parent, name) for parent, _, names in os.walk(folder) for name in names)
    return sum(is_picture(path) and path not in used for path in walked)
