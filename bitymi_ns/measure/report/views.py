"""Held-out views as ns-eval writes them, photograph beside render: the worst, the median and the best, with errors.

Folders with renders of the same photographs (of the trained scene and of its bundle, say) are compared view by view.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import numpy.typing as npt
from PIL import Image

from bitymi_ns.measure.report.gallery import Picture, encode, open_image, titles
from bitymi_ns.measure.report.records import is_bundle_name

ERROR_SCALE = 0.25
"""Error at which an error map ends: mean absolute difference of the three colours."""
ERROR_CAPTION = f"error: mean of |difference| over the colours, 0 (black) to {ERROR_SCALE:g} (yellow)"
MAX_SETS = 4
"""Sets of photographs that a page shows views of."""
_SIDE_BY_SIDE = re.compile(r"^eval_img_(?P<index>\d{4,})$", re.IGNORECASE)
_RANKS = (("Worst view", 0.0), ("Median view", 0.5), ("Best view", 1.0))

Pixels = npt.NDArray[np.float32]


@dataclass(frozen=True)
class ComparedView:
    """A view: its heading, and columns of pictures: the photograph, then for every folder the render and its error."""

    title: str
    columns: tuple[tuple[Picture, ...], ...]

    @property
    def stacks(self) -> tuple[tuple[Picture, ...], ...]:
        """Pictures that stand below each other: the columns; with one folder every picture, its error beside it."""
        if len(self.columns) > 2:
            return self.columns
        return tuple((picture,) for column in self.columns for picture in column)


@dataclass(frozen=True)
class ComparedSet:
    """The chosen views of one set of photographs."""

    title: str
    views: tuple[ComparedView, ...]


@dataclass(frozen=True)
class _Render:
    path: Path
    psnr: float
    photograph: bytes
    """Its digest."""


def heat(values: Pixels, scale: float) -> Pixels:
    """[H, W] values as colours [H, W, 3]: black at 0, yellow at `scale` and above."""
    return matplotlib.colormaps["inferno"](np.clip(values / scale, 0.0, 1.0))[..., :3].astype(np.float32)


def compare_views(images: Sequence[Path]) -> tuple[list[ComparedSet], list[Path], list[str]]:
    """Choose and encode views among images.

    Views are ranked by the PSNR of their pictures, averaged over the folders; a picture does not tell what is masked.

    Returns:
        the sets, the images that are no photograph beside a render, and a note for each that could not be read.
    """
    folders: dict[Path, dict[int, _Render]] = {}
    others, notes = [], []
    for path in sorted(p.resolve() for p in images):
        match = _SIDE_BY_SIDE.match(path.stem)
        if match is None:
            others.append(path)
            continue
        try:
            photograph, render = _halves(path)
        except OSError as error:
            notes.append(f"{path} is not an image that can be read: {error}.")
            continue
        digest = hashlib.sha256(photograph.tobytes()).digest()
        folders.setdefault(path.parent, {})[int(match["index"])] = _Render(path, _psnr(photograph, render), digest)
    groups: dict[tuple, list[Path]] = {}
    for folder, renders in folders.items():
        groups.setdefault(tuple((index, r.photograph) for index, r in renders.items()), []).append(folder)
    if len(groups) > MAX_SETS:
        notes.append(f"Views of {len(groups) - MAX_SETS} more sets are not shown; the page holds those of {MAX_SETS}.")
    names = titles(list(folders))
    ordered = [sorted(g, key=lambda f: (is_bundle_name(names[f]), names[f])) for g in groups.values()]
    return [_compared(group, folders, names) for group in ordered[:MAX_SETS]], others, notes


def _halves(path: Path) -> tuple[Pixels, Pixels]:
    """Photograph and render, [H, W, 3] in [0, 1]."""
    pixels = np.asarray(open_image(path).convert("RGB"), np.float32) / 255.0
    width = pixels.shape[1] // 2
    if pixels.shape[1] != 2 * width or width == 0:
        raise OSError(f"its width of {pixels.shape[1]} pixels is not that of two equal pictures")
    return pixels[:, :width], pixels[:, width:]


def _psnr(a: Pixels, b: Pixels) -> float:
    return 10.0 * math.log10(1.0 / max(1e-10, float(np.mean((a - b) ** 2, dtype=np.float64))))


def _compared(group: list[Path], folders: dict[Path, dict[int, _Render]], names: dict[Path, str]) -> ComparedSet:
    renders = [folders[folder] for folder in group]
    ranked = sorted(renders[0], key=lambda index: sum(r[index].psnr for r in renders))
    chosen: dict[int, str] = {}
    for name, place in _RANKS:
        chosen.setdefault(ranked[round(place * (len(ranked) - 1))], name)
    views = []
    for index, name in chosen.items():
        columns = []
        for folder, files in zip(group, renders, strict=True):
            photograph, render = _halves(files[index].path)
            if not columns:
                columns.append((encode(_image(photograph), "photograph"),))
            error = heat(np.abs(photograph - render).mean(-1), ERROR_SCALE)
            caption = f"{names[folder]}: {files[index].psnr:.2f} dB"
            columns.append((encode(_image(render), caption), encode(_image(error), f"error of {names[folder]}")))
        views.append(ComparedView(f"{name} of {len(ranked)}: number {index}", tuple(columns)))
    return ComparedSet(", ".join(names[folder] for folder in group), tuple(views))


def _image(pixels: Pixels) -> Image.Image:
    return Image.fromarray((pixels * 255.0).round().astype(np.uint8))
