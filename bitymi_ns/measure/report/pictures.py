"""Images embedded in a report: the best, median and worst held-out views that `ns-eval --render-output-path` wrote
(photograph, render, error; side by side if folders show the same photographs), and plots of estimated poses."""

import hashlib
import io
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import numpy.typing as npt
from PIL import Image

from bitymi_ns.measure.report.read import SIDE_BY_SIDE
from bitymi_ns.safe_reading import open_regular

ERROR_SCALE = 0.25  # error shown as yellow: mean absolute difference over the channels
ERROR_CAPTION = f"error: mean of |difference| over the colours, 0 (black) to {ERROR_SCALE:g} (yellow)"
MAX_SETS = 4  # sets of photographs per page
MAX_WORST = 16  # worst views per page
MAX_WIDTH = 1200  # of embedded images, pixels
MAX_PNG_BYTES = 400_000  # larger images are embedded as JPEG of quality 92
_RANKS = (("Worst view", 0.0), ("Median view", 0.5), ("Best view", 1.0))

Pixels = npt.NDArray[np.float32]


@dataclass(frozen=True)
class Picture:
    """An encoded image with its caption and size in pixels."""

    caption: str
    mime: str
    data: bytes
    width: int
    height: int


@dataclass(frozen=True)
class Group:
    """Columns of images under one heading."""

    title: str
    columns: tuple[tuple[Picture, ...], ...]


@dataclass(frozen=True)
class _Render:
    path: Path
    psnr: float
    digest: bytes  # of the photograph


def open_image(path: Path) -> Image.Image:
    """Read an image as RGB, or as RGBA if it has transparency. Raises OSError: the file is not a readable image."""
    open_regular(path).close()
    try:
        with Image.open(path, formats=("PNG", "JPEG")) as opened:
            return opened.convert("RGBA" if "A" in opened.getbands() or "transparency" in opened.info else "RGB")
    except (OSError, MemoryError):
        raise
    except Exception as error:  # Pillow raises many kinds on broken files
        raise OSError(str(error)) from error


def encode(image: Image.Image, caption: str) -> Picture:
    """Scale an image down if it is wide, and encode it."""
    image.thumbnail((MAX_WIDTH, image.height), Image.LANCZOS)
    buffer, mime = io.BytesIO(), "image/png"
    image.save(buffer, "PNG")
    if buffer.tell() > MAX_PNG_BYTES and image.mode == "RGB":
        buffer, mime = io.BytesIO(), "image/jpeg"
        image.save(buffer, "JPEG", quality=92, subsampling=0)
    return Picture(caption, mime, buffer.getvalue(), image.width, image.height)


def encode_files(files: Sequence[tuple[str, Path]], notes: list[str]) -> tuple[Picture, ...]:
    """Encode captioned files; appends a note for each that cannot be read."""
    pictures = []
    for caption, path in files:
        try:
            pictures.append(encode(open_image(path), caption))
        except OSError as error:
            notes.append(f"{path} is not an image that can be read: {error}.")
    return tuple(pictures)


def worst_views(views: Mapping[str, Sequence[tuple[str, Path]]], notes: list[str]) -> list[Group]:
    """Encode the images of the worst views, one group per view."""
    if len(views) > MAX_WORST:
        notes.append(f"{len(views) - MAX_WORST} more worst views are not shown; the page holds {MAX_WORST}.")
    read = {title: encode_files(files, notes) for title, files in list(views.items())[:MAX_WORST]}
    return [Group(title, tuple((picture,) for picture in pictures)) for title, pictures in read.items() if pictures]


def heat(values: Pixels, scale: float) -> Pixels:
    """Map [H, W] values to colours [H, W, 3]: black at 0, yellow at `scale` and above."""
    return matplotlib.colormaps["inferno"](np.clip(values / scale, 0.0, 1.0))[..., :3].astype(np.float32)


def compare_views(images: Sequence[Path], notes: list[str]) -> list[Group]:
    """Choose and encode views among images of photographs beside renders; appends a note for unreadable images.

    The columns of a view are the photograph and, for each folder, the render above its error map; with one folder the
    error map is beside the render. Views are ranked by PSNR without masks, averaged over the folders.
    """
    folders: dict[Path, dict[int, _Render]] = {}
    for path in sorted(p.resolve() for p in images):
        try:
            match = SIDE_BY_SIDE.match(path.stem)
            if match is None:
                raise OSError("its name is not eval_img_ with a number, as ns-eval names a photograph beside a render")
            photograph, render = _halves(path)
        except OSError as error:
            notes.append(f"{path} is not an image that can be shown: {error}.")
            continue
        digest = hashlib.sha256(photograph.tobytes()).digest()
        folders.setdefault(path.parent, {})[int(match["index"])] = _Render(path, _psnr(photograph, render), digest)
    groups: dict[tuple, list[Path]] = {}
    for folder, renders in folders.items():
        groups.setdefault(tuple((index, r.digest) for index, r in renders.items()), []).append(folder)
    if len(groups) > MAX_SETS:
        notes.append(f"Views of {len(groups) - MAX_SETS} more sets are not shown; the page holds those of {MAX_SETS}.")
    names = _titles(list(folders))
    ordered = [sorted(g, key=names.__getitem__) for g in groups.values()]
    return [view for group in ordered[:MAX_SETS] for view in _compared(group, folders, names, len(ordered) > 1)]


def _titles(folders: list[Path]) -> dict[Path, str]:
    if len(folders) < 2:
        return {folder: folder.name for folder in folders}
    shared = os.path.commonpath(folders)
    return {folder: os.path.relpath(folder, shared) if str(folder) != shared else folder.name for folder in folders}


def _halves(path: Path) -> tuple[Pixels, Pixels]:
    """Read photograph and render, [H, W, 3] in [0, 1], from an image of both."""
    pixels = np.asarray(open_image(path).convert("RGB"), np.float32) / 255.0
    width = pixels.shape[1] // 2
    if pixels.shape[1] != 2 * width or width == 0:
        raise OSError(f"its width of {pixels.shape[1]} pixels is not that of two equal pictures")
    return pixels[:, :width], pixels[:, width:]


def _psnr(a: Pixels, b: Pixels) -> float:
    return 10.0 * math.log10(1.0 / max(1e-10, float(np.mean((a - b) ** 2, dtype=np.float64))))


def _compared(
    group: list[Path], folders: dict[Path, dict[int, _Render]], names: dict[Path, str], named: bool
) -> list[Group]:
    renders = [folders[folder] for folder in group]
    ranked = sorted(renders[0], key=lambda index: sum(r[index].psnr for r in renders))
    chosen: dict[int, str] = {}
    for name, quantile in _RANKS:
        chosen.setdefault(ranked[round(quantile * (len(ranked) - 1))], name)
    views, title = [], f"{', '.join(names[folder] for folder in group)}: " if named else ""
    for index, name in chosen.items():
        columns = []
        for folder, files in zip(group, renders, strict=True):
            photograph, render = _halves(files[index].path)
            if not columns:
                columns.append((encode(_image(photograph), "photograph"),))
            error = heat(np.abs(photograph - render).mean(-1), ERROR_SCALE)
            caption = f"{names[folder]}: {files[index].psnr:.2f} dB"
            columns.append((encode(_image(render), caption), encode(_image(error), f"error of {names[folder]}")))
        if len(group) == 1:
            columns = [(picture,) for column in columns for picture in column]
        views.append(Group(f"{title}{name} of {len(ranked)}: number {index}", tuple(columns)))
    return views


def _image(pixels: Pixels) -> Image.Image:
    return Image.fromarray((pixels * 255.0).round().astype(np.uint8))
