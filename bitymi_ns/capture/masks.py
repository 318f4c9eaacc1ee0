"""Masks of photographs, for structure from motion and for training: finding, reading and checking them."""

import os
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path, PurePosixPath

import numpy as np
import numpy.typing as npt
from PIL import Image

from bitymi_ns.capture.folder_contents import open_picture
from bitymi_ns.capture.image_files import has_transparency, image_size, in_proportion, in_threads, wrong_size
from bitymi_ns.capture.kinds import PHOTOGRAPHS
from bitymi_ns.capture.sfm_photos import COPY
from bitymi_ns.capture.types import Photograph, fail, parsing, say
from bitymi_ns.trust import listed

LEAVE_OUT = "`bitymi-data --use-masks False` leaves masks out"
"""Remedy in messages on masks."""
USUAL_FOLDERS = ("images", "input", "image", "photos", "photographs", "rgb", "color")
"""Usual folders of photographs, the most usual first."""
LOSSY = {"JPEG", "MPO", "WEBP", "JPEG2000", "HEIF", "AVIF"}
"""Lossy formats by Pillow's names: black may come back as almost black."""
DYNAMIC_MASK = "dynamic_mask_"
"""Prefix of instant-ngp's masks beside photographs; black counts in them."""
MIDDLE = 127  # threshold of lossy masks, of 255


def mask_folder(photographs: Path, data: Path, stated: Path | None = None, downscale: int = 1) -> Path | None:
    """Find the folder of masks: `stated`, else the first `masks` beside the folder `photographs`, in it, or in `data`.
    It need not exist if that of reduced masks does (`masks_2` for a `downscale` of 2).

    If `data` is the folder of photographs, or in it, a `masks` beside it may belong to something else. It is used if
    the folder has a usual name: `bed/masks` for `bed/images`, but not `all/masks` for `all/bed`.

    Raises:
        CaptureError: neither the stated one nor its reduced one exists.
    """
    if stated is not None:
        if not _exists(stated, downscale):
            fail(f"the folder of masks {stated} does not exist")
        return stated
    shown, named = Path(os.path.abspath(photographs)), Path(os.path.abspath(data))
    folders = [shown, named]
    if shown.name in USUAL_FOLDERS or not named.is_relative_to(shown):
        folders.insert(0, shown.parent)
    return next((folder / "masks" for folder in folders if _exists(folder / "masks", downscale)), None)


def _exists(masks: Path, downscale: int) -> bool:
    return masks.is_dir() or (downscale > 1 and downscaled_masks(masks, downscale).is_dir())


def downscaled_masks(masks: Path, downscale: int) -> Path:
    return masks.with_name(f"{masks.name}_{downscale}")


def mask_of(masks: Path, name: str) -> Path | None:
    """Find the mask of a photograph: its name with .png appended (COLMAP), or its stem with any image suffix
    (nerfstudio). An upright copy has its photograph's mask."""
    stem = str(PurePosixPath(name).with_suffix(""))
    endings = (".png", *PHOTOGRAPHS)
    candidates = [f"{name}.png", *(stem + ending for ending in endings), f"{name}.PNG"]
    candidates += [stem + ending.upper() for ending in endings]
    found = next((masks / c for c in candidates if os.path.isfile(masks / c)), None)
    is_copy = found is None and name.endswith(COPY) and stem.lower().endswith(PHOTOGRAPHS)
    return mask_of(masks, stem) if is_copy else found


def read_mask(path: Path) -> Image.Image:
    """Read a mask as a 1-bit image, True where pixels count; see `mask_pixels`. instant-ngp's are inverted. Raises
    Pillow's errors."""
    with open_picture(path) as image:
        return Image.fromarray(mask_pixels(image) ^ path.name.startswith(DYNAMIC_MASK))


def mask_pixels(image: Image.Image) -> npt.NDArray[np.bool_]:
    """Threshold a mask to the pixels [H, W] that count: not wholly transparent, and not black, or above MIDDLE for
    lossy formats.

    As in COLMAP and nerfstudio, masks may hold zeros and ones, or class numbers. JPEG ripples around an edge are a few
    levels above black, but stay below MIDDLE.
    """
    if image.mode.startswith(("I", "F")):
        result = np.asarray(image) != 0
    else:
        limit = MIDDLE if image.format in LOSSY else 0
        result = (np.asarray(image.convert("RGB")) > limit).any(-1)
    if has_transparency(image):
        result = result & (np.asarray(image.convert("RGBA"))[..., 3] > 0)
    return result


def checked_mask(path: Path) -> Image.Image:
    """Read a mask, see `read_mask`. Raises CaptureError: it is missing, or cannot be read."""
    if not path.exists():
        fail(f"the mask {path} is missing")
    with parsing(f"the mask {path}", "Replace it, or remove the masks from the capture."):
        return read_mask(path)


def masks_named(masks: Path, names: Sequence[str], needed: bool = True) -> list[Path] | None:
    """Find masks of photographs by their names in a folder; None if it has none and they are not `needed`. Raises
    CaptureError: a mask is missing otherwise."""
    found = {name: mask_of(masks, name) for name in names}
    missing = [name for name, file in found.items() if file is None]
    if len(missing) == len(found) and not needed:
        return None
    if missing:
        others = "" if len(missing) == len(found) else ", but of others"
        fail(
            f"{masks} has no mask of {listed(missing)}{others}. Give every photograph a mask of its name with .png (a "
            f"white picture lets all pixels count); {LEAVE_OUT}."
        )
    return [file for name in names if (file := found[name]) is not None]


def with_masks(photographs: Sequence[Photograph], capture: Path, base: Path | None = None) -> list[Photograph]:
    """Add masks to photographs, and report it: instant-ngp's beside them, where some may be missing, or from a folder
    `masks` (`mask_folder`). `base`: folder of the photographs, whose paths in it name the masks; None = their
    common folder. Raises CaptureError: the folder has masks of some photographs only."""
    files = [each.file for each in photographs]
    dynamic = [file.with_name(f"{DYNAMIC_MASK}{file.stem}.png") for file in files]
    found: Sequence[Path | None] | None = [file if os.path.isfile(file) else None for file in dynamic]
    if any(found):
        count = sum(file is not None for file in found)
        said = f"{count} masks {DYNAMIC_MASK}*.png beside {len(files)} photographs are used, of which black counts"
    else:
        base = base or Path(os.path.commonpath([os.path.abspath(file.parent) for file in files]))
        masks = mask_folder(base, capture)
        names = [os.path.relpath(file, base) for file in files]
        found = None if masks is None else masks_named(masks, names, needed=False)
        said = f"The masks of {masks} are used, of which black does not count"
    if found is None:
        return list(photographs)
    say(f"{said}; {LEAVE_OUT}.")
    return [replace(each, mask=mask) for each, mask in zip(photographs, found, strict=True)]


def check_masks(photographs: Sequence[Photograph]) -> None:
    """Fail if masks are missing or cannot be used, before time is spent on the photographs."""
    masked = {each.mask: each for each in photographs if each.mask is not None}
    missing = [mask for mask in masked if not os.path.exists(mask)]
    if missing:
        where = f"{len(missing)} of {len(masked)} masks of the capture are missing: {listed(missing)}"
        fail(f"{where}. Put them there, or correct their names; {LEAVE_OUT}.")
    sizes = in_threads(image_size, masked) if masked else []
    for (mask, photograph), known in zip(masked.items(), sizes, strict=True):
        size = known or checked_mask(mask).size  # fails with the reason
        if not in_proportion(size, photograph.camera.size):
            fail(f"{wrong_size(mask, size, photograph.camera.size)} {LEAVE_OUT[0].upper()}{LEAVE_OUT[1:]}.")
