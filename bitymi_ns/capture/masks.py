"""Masks of photographs, for structure from motion and for training."""

import os
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path, PurePath

import numpy as np
import numpy.typing as npt
from PIL import Image

from bitymi_ns.trust import listed
from .cache import emptied
from .folder_contents import is_picture, open_picture
from .image_files import has_transparency, image_size, in_proportion, in_threads, wrong_size
from .kinds import DYNAMIC, MASK, PHOTOGRAPHS
from .sfm_photos import COPY
from .types import Photograph, fail, parsing, say

LEAVE_OUT = "`bitymi-data --use-masks False` leaves masks out"  # remedy in messages
USUAL_FOLDERS = ("images", "input", "image", "photos", "photographs", "rgb", "color")
"""Folders of photographs, the most usual first."""
LOSSY = {"JPEG", "MPO", "WEBP", "JPEG2000", "HEIF", "AVIF"}
"""Pillow's names of lossy formats: black may come back as almost black."""
MIDDLE = 127  # threshold of lossy masks, of 255


def mask_folder(photographs: Path, data: Path, stated: Path | None = None, downscale: int = 1) -> Path | None:
    """Find the folder of masks: `stated`, else the first `masks` or `mask` beside the folder `photographs`, in it, or
    in `data`; else that of reduced masks (`masks_2`). Beside `data` itself it counts only if that has a usual name:
    `bed/masks` for `bed/images`, not `all/masks` for `all/bed`. Raises CaptureError: `stated` is missing."""
    shown, named = Path(os.path.abspath(photographs)), Path(os.path.abspath(data))
    folders = [shown, named]
    if shown.name in USUAL_FOLDERS or not named.is_relative_to(shown):
        folders.insert(0, shown.parent)
    whole = [folder / name for folder in folders for name in ("masks", "mask")] if stated is None else [stated]
    reduced = [masks.with_name(f"{masks.name}_{downscale}") for masks in whole if downscale > 1]
    masks = next(filter(os.path.isdir, (*whole, *reduced)), None)
    if masks is None and stated is not None:
        fail(f"the folder of masks {stated} does not exist. Correct --masks-path, which is seen from {data}.")
    return masks


def find_masks(
    names: Sequence[str], base: Path, masks: Path | None, stated: bool = False
) -> tuple[dict[str, Path], bool]:
    """Find masks by the photographs' names in the folder `base`: beside them unless a folder is `stated`, else in
    `masks`. Return them by name, and whether they are beside."""
    beside = {} if stated else _named(names, base, (*MASK.names.split(), *DYNAMIC.names.split()))
    if beside or masks is None:
        return beside, bool(beside)
    return _named(names, masks, ("NAME", *MASK.names.split())), False


def _named(names: Sequence[str], folder: Path, forms: Sequence[str]) -> dict[str, Path]:
    """Find files in a folder by names of these forms, with NAME a photograph's with its ending (COLMAP) or without
    (nerfstudio), or its number (IDR). An upright copy has its photograph's mask."""
    there: dict[PurePath, dict[str, Path]] = {}
    for parent in {PurePath(name).parent for name in names}:
        files = sorted(filter(is_picture, (folder / parent).glob("*")), key=lambda file: file.suffix.lower() != ".png")
        stems = [file.stem.lower() for file in files]
        exact = dict(zip(reversed(stems), reversed(files), strict=True))
        there[parent] = {f"{int(stem)}": file for stem, file in exact.items() if stem.isdecimal()} | exact
    mask_of = {}
    for path in map(PurePath, names):
        bases = [path.name.lower(), path.stem.lower()]
        if bases[0].endswith(COPY) and bases[1].endswith(PHOTOGRAPHS):
            bases.append(PurePath(bases[1]).stem)
        bases += [f"{int(path.stem)}"] if path.stem.isdecimal() else []
        files = (there[path.parent].get(form.replace("NAME", each)) for each in bases for form in forms)
        if mask := next(filter(None, files), None):
            mask_of[str(path)] = mask
    return mask_of


def _is_dynamic(path: Path) -> bool:
    return path.name.lower().startswith(DYNAMIC.names.removesuffix("NAME"))


def mask_pixels(image: Image.Image) -> npt.NDArray[np.bool_]:
    """Test which pixels [H, W] of a mask count: not wholly transparent, and not black, as masks may hold zeros and ones
    or class numbers; or above MIDDLE in lossy formats, where black has ripples around an edge."""
    if image.mode.startswith(("I", "F")):
        result = np.asarray(image) != 0
    else:
        limit = MIDDLE if image.format in LOSSY else 0
        result = (np.asarray(image.convert("RGB")) > limit).any(-1)
    if has_transparency(image):
        result = result & (np.asarray(image.convert("RGBA"))[..., 3] > 0)
    return result


def checked_mask(path: Path) -> Image.Image:
    """Read a mask as a 1-bit image, True where pixels count. Raises CaptureError: it cannot be read."""
    with parsing(f"the mask {path}", "Replace it, or remove the masks."), open_picture(path) as image:
        return Image.fromarray(mask_pixels(image) ^ _is_dynamic(path))


def with_masks(
    photographs: Sequence[Photograph],
    capture: Path,
    base: Path | None = None,
    stated: Path | None = None,
    downscale: int = 1,
    images: Path | None = None,
) -> list[Photograph]:
    """Add masks to photographs, see `find_masks`, and report it. Raises CaptureError: a folder has masks of some only,
    or of none and is `stated` or that of a model. `base`: folder in which the photographs' paths name the masks, None =
    their common one; `images`: folder of a model's files, named as in `base`."""
    files = [each.file for each in photographs]
    base = base or Path(os.path.commonpath([os.path.abspath(file.parent) for file in files]))
    names = [os.path.normpath(os.path.relpath(file, images or base)) for file in files]
    masks = mask_folder(base, capture, None if stated is None else capture / stated, downscale)
    mask_of, beside = find_masks(names, base, masks, stated is not None)
    missing = [name for name in names if name not in mask_of]
    if masks and missing and not beside and (mask_of or stated or images):
        advice = "Give every photograph a mask of its name with .png, all white if all counts"
        fail(f"{masks} has no mask of {listed(missing)}. {advice}; {LEAVE_OUT}.")
    if mask_of:
        first = listed([path.name for path in mask_of.values()], most=1)
        where = f"{first} beside {len(files)} photographs" if beside else f"of {masks}"
        black = "counts" if beside and all(map(_is_dynamic, mask_of.values())) else "does not count"
        say(f"The masks {where} are used, of which black {black}; {LEAVE_OUT}.")
    return [replace(each, mask=mask_of.get(name)) for each, name in zip(photographs, names, strict=True)]


def check_masks(photographs: Sequence[Photograph]) -> None:
    """Fail if masks are missing or cannot be used."""
    masked = {each.mask: each for each in photographs if each.mask is not None}
    missing = [mask for mask in masked if not os.path.exists(mask)]
    if missing:
        which = f"{len(missing)} of {len(masked)} masks of the capture are missing: {listed(missing)}"
        fail(f"{which}. Put them there, or correct their names; {LEAVE_OUT}.")
    sizes = in_threads(image_size, masked) if masked else []
    for (mask, photograph), known in zip(masked.items(), sizes, strict=True):
        size = known or checked_mask(mask).size
        if not in_proportion(size, photograph.camera.size):
            fail(f"{wrong_size(mask, size, photograph.camera.size)} {LEAVE_OUT}.")


def write_colmap_masks(folder: Path, masks: Mapping[str, tuple[Path, tuple[int, int]]]) -> str | None:
    """Write masks as COLMAP reads them, grey and of the photographs' sizes; return their folder, None = no masks."""
    emptied(folder)
    for name, (path, size) in masks.items():
        mask = checked_mask(path)
        if not in_proportion(mask.size, size):
            fail(wrong_size(path, mask.size, size))
        mask.resize(size, Image.Resampling.NEAREST).convert("L").save(folder / f"{name}.png")
    return str(folder.resolve()) if masks else None
