"""Images embedded in a report: the best, median and worst held-out views that `ns-eval --render-output-path` wrote
(photograph, render, error; side by side if folders show the same photographs)."""

import hashlib
import io
import math
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
"""File name of a photograph beside its render, as `ns-eval --render-output-path` writes it."""
ERROR_SCALE = 0.25  # error shown as yellow: mean absolute difference over the channels
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
    """A photograph beside its render: file, PSNR in dB, and digest of the photograph."""

    path: Path
    psnr: float
    digest: bytes


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
    image.thumbnail((MAX_WIDTH, image.height), Image.Resampling.LANCZOS)
    buffer = io.BytesIO()
    image.save(buffer, "JPEG", quality=92, subsampling=0)
    return Picture(caption, buffer.getvalue(), image.width, image.height)


def _halves(path: Path) -> tuple[Pixels, Pixels]:
    """Read photograph and render, [H, W, 3] in [0, 1], from an image of both."""
    pixels = np.asarray(open_image(path), np.float32) / 255.0
    width = pixels.shape[1] // 2
    if pixels.shape[1] != 2 * width or width == 0:
        raise OSError(f"its width of {pixels.shape[1]} pixels is not that of two equal pictures")
    return pixels[:, :width], pixels[:, width:]


def compare_views(images: Sequence[Path], notes: list[str]) -> list[Group]:
    """Choose and encode views among images of photographs beside renders; appends a note for unreadable images.

    The columns of a view are the photograph and, for each folder, the render above its error map; with one folder the
    error map is beside the render. Views are ranked by PSNR without masks, averaged over the folders.
    """
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
        squared = float(np.mean((photograph - render) ** 2, dtype=np.float64))
        digest = hashlib.sha256(photograph.tobytes()).digest()
        view = View(path, -10.0 * math.log10(max(1e-10, squared)), digest)
        folders.setdefault(path.parent, {})[int(match[1])] = view
    sets = list(grouped(folders, lambda f: tuple((i, view.digest) for i, view in folders[f].items())).values())
    if len(sets) > MAX_SETS:
        notes.append(f"Views of {len(sets) - MAX_SETS} more sets are not shown; the page holds those of {MAX_SETS}.")
    shared = os.path.commonpath([folder.parent for folder in folders]) if folders else ""
    groups = []
    for members in sets[:MAX_SETS]:
        views = {os.path.relpath(folder, shared): folders[folder] for folder in sorted(members)}
        first = folders[members[0]]
        ranked = sorted(first, key=lambda index, views=views: sum(of[index].psnr for of in views.values()))
        title = f"{', '.join(views)}: " if len(sets) > 1 else ""
        chosen: dict[int, str] = {}
        for rank, quantile in RANKS.items():
            chosen.setdefault(ranked[round(quantile * (len(ranked) - 1))], rank)
        for index, rank in chosen.items():
            columns = [[_encode(_halves(first[index].path)[0], "photograph")]]
            for name, of in views.items():
                photograph, render = _halves(of[index].path)
                error = np.clip(np.abs(photograph - render).mean(-1) / ERROR_SCALE, 0.0, 1.0)
                heat = matplotlib.colormaps["inferno"](error)[..., :3].astype(np.float32)
                drawn = [_encode(render, f"{name}: {of[index].psnr:.2f} dB"), _encode(heat, f"error of {name}")]
                columns += [drawn] if len(views) > 1 else [[picture] for picture in drawn]
            groups.append(Group(f"{title}{rank} of {len(ranked)}: number {index}", columns))
    return groups
