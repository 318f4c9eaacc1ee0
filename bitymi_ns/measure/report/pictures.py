"""Images embedded in a report: the best, median and worst held-out views that `ns-eval --render-output-path` wrote
(photograph, render, error; side by side if folders show the same photographs)."""

import hashlib
import io
import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import numpy.typing as npt
from PIL import Image

from bitymi_ns.safe_reading import open_regular

SIDE_BY_SIDE = re.compile(r"^eval_img_(?P<index>\d{4,})$", re.IGNORECASE)
"""File name stem of a photograph beside its render, as `ns-eval --render-output-path` writes it."""
ERROR_SCALE = 0.25  # error shown as yellow: mean absolute difference over the channels
ERROR_CAPTION = f"error: mean of |difference| over the colours, 0 (black) to {ERROR_SCALE:g} (yellow)"
MAX_SETS = 4  # sets of photographs per page
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
    """Read an image as RGB. Raises OSError: the file is not a readable image."""
    open_regular(path).close()
    try:
        with Image.open(path, formats=("PNG", "JPEG")) as opened:
            return opened.convert("RGB")
    except (OSError, MemoryError):
        raise
    except Exception as error:  # Pillow raises many kinds on broken files
        raise OSError(str(error)) from error


def _encode(pixels: Pixels, caption: str) -> Picture:
    """Scale an image [H, W, 3] in [0, 1] down if it is wide, and encode it."""
    image = Image.fromarray((pixels * 255.0).round().astype(np.uint8))
    image.thumbnail((MAX_WIDTH, image.height), Image.LANCZOS)
    buffer, mime = io.BytesIO(), "image/png"
    image.save(buffer, "PNG")
    if buffer.tell() > MAX_PNG_BYTES:
        buffer, mime = io.BytesIO(), "image/jpeg"
        image.save(buffer, "JPEG", quality=92, subsampling=0)
    return Picture(caption, mime, buffer.getvalue(), image.width, image.height)


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
        squared = float(np.mean((photograph - render) ** 2, dtype=np.float64))
        digest = hashlib.sha256(photograph.tobytes()).digest()
        of_folder = folders.setdefault(path.parent, {})
        of_folder[int(match["index"])] = _Render(path, -10.0 * math.log10(max(1e-10, squared)), digest)
    sets: dict[tuple, list[Path]] = {}
    for folder, renders in folders.items():
        sets.setdefault(tuple((index, r.digest) for index, r in renders.items()), []).append(folder)
    if len(sets) > MAX_SETS:
        notes.append(f"Views of {len(sets) - MAX_SETS} more sets are not shown; the page holds those of {MAX_SETS}.")
    shared = os.path.commonpath(folders) if len(folders) > 1 else ""
    groups = []
    for members in list(sets.values())[:MAX_SETS]:
        names = {os.path.relpath(f, shared) if shared not in ("", str(f)) else f.name: folders[f] for f in members}
        groups += _compared(dict(sorted(names.items())), len(sets) > 1)
    return groups


def _halves(path: Path) -> tuple[Pixels, Pixels]:
    """Read photograph and render, [H, W, 3] in [0, 1], from an image of both."""
    pixels = np.asarray(open_image(path), np.float32) / 255.0
    width = pixels.shape[1] // 2
    if pixels.shape[1] != 2 * width or width == 0:
        raise OSError(f"its width of {pixels.shape[1]} pixels is not that of two equal pictures")
    return pixels[:, :width], pixels[:, width:]


def _compared(folders: dict[str, dict[int, _Render]], named: bool) -> list[Group]:
    """Encode the views of folders that show the same photographs; `named`: the folders are in the titles."""
    first = next(iter(folders.values()))
    ranked = sorted(first, key=lambda index: sum(renders[index].psnr for renders in folders.values()))
    chosen: dict[int, str] = {}
    for rank, quantile in _RANKS:
        chosen.setdefault(ranked[round(quantile * (len(ranked) - 1))], rank)
    views, title = [], f"{', '.join(folders)}: " if named else ""
    for index, rank in chosen.items():
        columns = [(_encode(_halves(first[index].path)[0], "photograph"),)]
        for name, renders in folders.items():
            photograph, render = _halves(renders[index].path)
            error = np.clip(np.abs(photograph - render).mean(-1) / ERROR_SCALE, 0.0, 1.0)
            heat = matplotlib.colormaps["inferno"](error)[..., :3].astype(np.float32)
            drawn = _encode(render, f"{name}: {renders[index].psnr:.2f} dB"), _encode(heat, f"error of {name}")
            columns += [drawn] if len(folders) > 1 else [(picture,) for picture in drawn]
        views.append(Group(f"{title}{rank} of {len(ranked)}: number {index}", tuple(columns)))
    return views
