"""Rendered images for the page: a few views of each folder, at a size that a page can carry."""

from __future__ import annotations

import io
import re
from dataclasses import dataclass
from pathlib import Path

from PIL import Image

from bitymi_ns.measure.report.records import WorstView

VIEWS_PER_FOLDER = 4
MAX_WORST = 16
"""Worst views that a page shows."""
MAX_IMAGES = 48
MAX_WIDTH = 1200
"""Width in pixels to which wider images are scaled down."""
MAX_PNG_BYTES = 400_000
"""Images that are larger as PNG are embedded as JPEG of quality 92."""

_NUMBERED = re.compile(r"^(?P<prefix>.+?)_(?P<key>.+)_(?P<index>\d{4,})$")


@dataclass(frozen=True)
class Picture:
    """An image ready to be embedded."""

    caption: str
    mime: str
    data: bytes
    width: int
    height: int


@dataclass(frozen=True)
class Group:
    """The pictures of one folder."""

    title: str
    pictures: tuple[Picture, ...]
    left_out: int

    @property
    def broad(self) -> bool:
        """Whether a picture needs half of the page's width."""
        return any(picture.width > 2.2 * picture.height for picture in self.pictures)


def open_image(path: Path) -> Image.Image:
    """Read an image as RGB, or as RGBA where it has transparency.

    Raises:
        OSError: the file is not an image that can be read.
    """
    try:
        with Image.open(path, formats=("PNG", "JPEG")) as opened:
            return opened.convert("RGBA" if "A" in opened.getbands() or "transparency" in opened.info else "RGB")
    except (SyntaxError, ValueError, Image.DecompressionBombError) as error:  # what Pillow raises on broken PNG chunks
        raise OSError(str(error)) from error


def encode(image: Image.Image, caption: str) -> Picture:
    """Scale an image down if it is wide, and encode it."""
    if image.width > MAX_WIDTH:
        image = image.resize((MAX_WIDTH, max(1, round(image.height * MAX_WIDTH / image.width))), Image.LANCZOS)
    buffer, mime = io.BytesIO(), "image/png"
    image.save(buffer, "PNG")
    if buffer.tell() > MAX_PNG_BYTES and image.mode == "RGB":
        buffer, mime = io.BytesIO(), "image/jpeg"
        image.save(buffer, "JPEG", quality=92, subsampling=0)
    return Picture(caption, mime, buffer.getvalue(), image.width, image.height)


def _caption(path: Path) -> str:
    match = _NUMBERED.match(path.stem)
    if not match:
        return path.stem.replace("_", " ")
    view, key = f"view {int(match['index'])}", match["key"].replace("_", " ")
    return view if key == "img" else f"{view}, {key}"


def _chosen(paths: list[Path]) -> list[Path]:
    """Images of a few evenly spaced views; the same views in every folder of the same test set."""
    numbers = {path: match["index"] for path in paths if (match := _NUMBERED.match(path.stem))}
    indices = sorted(set(numbers.values()))
    step = (len(indices) - 1) / max(1, min(len(indices), VIEWS_PER_FOLDER) - 1)
    kept = {indices[round(i * step)] for i in range(min(len(indices), VIEWS_PER_FOLDER))}
    single = [path for path in paths if path not in numbers]
    return single[:VIEWS_PER_FOLDER] + sorted((p for p in numbers if numbers[p] in kept), key=lambda p: (numbers[p], p))


def titles(folders: list[Path]) -> dict[Path, str]:
    """Folder paths without what all of them share."""
    if len(folders) < 2:
        return {folder: folder.name for folder in folders}
    shared = 0
    for names in zip(*(folder.parts for folder in folders), strict=False):
        if len(set(names)) > 1:
            break
        shared += 1
    return {folder: "/".join(folder.parts[shared:]) or folder.name for folder in folders}


def make_gallery(images: list[Path]) -> tuple[list[Group], list[str]]:
    """Encode the chosen images of each folder.

    Returns:
        groups in order of folders, and a note for each image that could not be read or folder that was left out.
    """
    folders: dict[Path, list[Path]] = {}
    for path in sorted(p.resolve() for p in images):
        folders.setdefault(path.parent, []).append(path)
    names = titles(list(folders))
    groups, notes, total = [], [], 0
    for folder, paths in folders.items():
        pictures = []
        chosen = _chosen(paths)
        if total + len(chosen) > MAX_IMAGES:
            notes.append(f"{folder}: its {len(paths)} images are not shown; the page holds {MAX_IMAGES} at most.")
            continue
        for path in chosen:
            try:
                pictures.append(encode(open_image(path), _caption(path)))
            except OSError as error:
                notes.append(f"{path} is not an image that can be read: {error}.")
        if pictures:
            groups.append(Group(names[folder], tuple(pictures), len(paths) - len(chosen)))
            total += len(pictures)
    return groups, notes


def make_worst(views: list[WorstView]) -> tuple[list[Group], list[str]]:
    """Encode the pictures of the worst views, one group per view; and a note for each that could not be read."""
    groups, notes = [], []
    for view in views[:MAX_WORST]:
        pictures = []
        for caption, path in view.pictures:
            try:
                pictures.append(encode(open_image(path), caption))
            except OSError as error:
                notes.append(f"{path} is not an image that can be read: {error}.")
        if pictures:
            groups.append(Group(view.title, tuple(pictures), 0))
    if len(views) > MAX_WORST:
        notes.append(f"{len(views) - MAX_WORST} more worst views are not shown; the page holds {MAX_WORST}.")
    return groups, notes
