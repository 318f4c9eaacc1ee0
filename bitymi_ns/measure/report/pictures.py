"""Images in a report: the worst, median and best held-out views that `ns-eval --render-output-path` wrote."""

import hashlib
import io
import os
import re
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

import matplotlib
import numpy as np
import numpy.typing as npt
from PIL import Image

from bitymi_ns.safe_reading import open_regular
from .records import grouped

SIDE_BY_SIDE = re.compile(r"eval_img_(\d{4,})\.png$", re.IGNORECASE)
"""File name of a photograph beside its render, as ns-eval writes it."""
ERROR_SCALE = 0.25  # mean absolute difference shown as yellow
MAX_SETS = 4  # sets of photographs per page
MAX_WIDTH = 1200  # of embedded images, pixels
RANKS = {"Worst view": 0.0, "Median view": 0.5, "Best view": 1.0}

Pixels = npt.NDArray[np.float32]


class Picture(NamedTuple):
    """A JPEG image with its caption and size in pixels."""

    caption: str
    data: bytes
    width: int
    height: int


class Group(NamedTuple):
    """Columns of images under one heading."""

    title: str
    columns: list[list[Picture]]


class View(NamedTuple):
    """A photograph beside its render."""

    path: Path
    psnr: float  # dB
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
    """Encode an image [H, W, 3] in [0, 1], scaled down if it is wide."""
    image = Image.fromarray((pixels * 255.0).round().astype(np.uint8))
    image.thumbnail((MAX_WIDTH, image.height), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=92, subsampling=0)
    return Picture(caption, buffer.getvalue(), image.width, image.height)


def _halves(path: Path) -> tuple[Pixels, Pixels]:
    """Read photograph and render, [H, W, 3] in [0, 1], from an image of both."""
    pixels = np.asarray(open_image(path), np.float32) / 255.0
    width = pixels.shape[1]
    if width % 2:
        raise OSError(f"its width of {width} pixels is not that of two equal pictures")
    return pixels[:, : width // 2], pixels[:, width // 2 :]


def _columns(views: dict[str, View]) -> list[list[Picture]]:
    """Draw a photograph, and each folder's render above its error map, or beside it for one folder."""
    columns = []
    for name, view in views.items():
        photograph, render = _halves(view.path)
        error = np.clip(np.abs(photograph - render).mean(-1) / ERROR_SCALE, 0.0, 1.0)
        heat = matplotlib.colormaps["inferno"](error)[..., :3].astype(np.float32)
        drawn = [_encode(render, f"{name}: {view.psnr:.2f} dB"), _encode(heat, f"error of {name}")]
        columns = columns or [[_encode(photograph, "photograph")]]
        columns += [drawn] if len(views) > 1 else [[picture] for picture in drawn]
    return columns


def compare_views(images: Sequence[Path], notes: list[str]) -> list[Group]:
    """Choose and draw views, ranked by their PSNR averaged over the folders that show the same photographs; appends a
    note for unreadable images."""
    folders: dict[Path, dict[int, View]] = {}
    for path in sorted(p.resolve() for p in images):
        match = SIDE_BY_SIDE.match(path.name)
        try:
            if match is None:
                raise OSError("its name is not eval_img_ with a number, as ns-eval names a photograph beside a render")
            photograph, render = _halves(path)
        except OSError as error:
            notes.append(f"{path} is not an image that can be shown: {error}.")
            continue
        psnr = -10.0 * np.log10(max(1e-10, np.mean((photograph - render) ** 2, dtype=np.float64)))
        digest = hashlib.sha256(photograph.tobytes()).digest()
        folders.setdefault(path.parent, {})[int(match[1])] = View(path, float(psnr), digest)
    sets = list(grouped(folders, lambda f: tuple((i, view.digest) for i, view in folders[f].items())).values())
    if len(sets) > MAX_SETS:
        notes.append(f"Views of {len(sets) - MAX_SETS} more sets are not shown; the page holds those of {MAX_SETS}.")
    shared = os.path.commonpath([folder.parent for folder in folders]) if folders else ""
    groups = []
    for members in sets[:MAX_SETS]:
        views = {os.path.relpath(folder, shared): folders[folder] for folder in sorted(members)}
        title = f"{', '.join(views)}: " if len(sets) > 1 else ""
        numbers = list(folders[members[0]])
        ranked = sorted(numbers, key=lambda i, views=views: sum(folder[i].psnr for folder in views.values()))
        chosen: dict[int, str] = {}
        for rank, quantile in RANKS.items():
            chosen.setdefault(ranked[round(quantile * (len(ranked) - 1))], rank)
        for i, rank in chosen.items():
            columns = _columns({name: folder[i] for name, folder in views.items()})
            groups.append(Group(f"{title}{rank} of {len(ranked)}: number {i}", columns))
    return groups
