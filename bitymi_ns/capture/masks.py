"""Masks of photographs: which folder holds them, which file belongs to a photograph, and which of its pixels count.

The finding of poses and the training go by these rules alike.
"""

from __future__ import annotations

import os
from pathlib import Path, PurePosixPath

import numpy as np
import numpy.typing as npt
from PIL import Image

from bitymi_ns.capture.photos import COPY
from bitymi_ns.capture.recognise import PHOTOGRAPHS
from bitymi_ns.capture.types import CaptureError

USUAL_FOLDERS = ("images", "input", "image", "photos", "photographs", "rgb", "color")
"""Names of a capture's folder of photographs, the most usual first."""
LOSSY = {"JPEG", "MPO", "WEBP", "JPEG2000", "HEIF", "AVIF"}
"""Formats, as Pillow names them, that may give black back as almost black."""
MIDDLE = 127
"""Of 8 bits; pixels of a lossy mask count above it."""
PROPORTIONS = 0.02
"""Relative difference between the proportions of a mask and its photograph below which it is taken for rounding."""


def mask_folder(photographs: Path, data: Path, given: Path | None = None, reduction: int = 1) -> Path | None:
    """The folder of a capture's masks: the given one; else `masks` beside the folder of the photographs, in that
    folder, or in that of the data, the first of them that is there.

    Beside a folder that is the data, or holds it, lie other things than the capture. There `masks` is used if the
    folder has a usual name for the photographs of a capture: `bed/masks` for `bed/images`, but not `all/masks` for
    `all/bed`.

    Args:
        photographs: their folder.
        data: what the user names as the capture, a folder.
        given: what the user names as the folder of masks.
        reduction: a folder is there, too, if there is one of masks that are so many times smaller, as `masks_2`.

    Raises:
        CaptureError: the given one is not there.
    """
    if given is not None:
        if not _is_there(given, reduction):
            raise CaptureError(f"the folder of masks {given} does not exist")
        return given
    shown, named = Path(os.path.abspath(photographs)), Path(os.path.abspath(data))
    places = [shown, named]
    if shown.name in USUAL_FOLDERS or not named.is_relative_to(shown):
        places.insert(0, shown.parent)
    return next((place / "masks" for place in places if _is_there(place / "masks", reduction)), None)


def _is_there(masks: Path, reduction: int) -> bool:
    return masks.is_dir() or (reduction > 1 and downscaled_masks(masks, reduction).is_dir())


def downscaled_masks(masks: Path, reduction: int) -> Path:
    """Where masks that are so many times smaller lie."""
    return masks.with_name(f"{masks.name}_{reduction}")


def mask_of(masks: Path, name: str) -> Path | None:
    """The mask of a photograph: NAME.png after the whole name, as COLMAP has it, or the same name with any suffix of an
    image, as nerfstudio has it. That of an upright copy is that of the photograph."""
    stem = str(PurePosixPath(name).with_suffix(""))
    endings = (".png", *PHOTOGRAPHS)
    candidates = [f"{name}.png", *(stem + ending for ending in endings), f"{name}.PNG"]
    candidates += [stem + ending.upper() for ending in endings]
    found = next((masks / c for c in candidates if (masks / c).is_file()), None)
    is_copy = found is None and name.endswith(COPY) and stem.lower().endswith(PHOTOGRAPHS)
    return mask_of(masks, stem) if is_copy else found


def mask_pixels(image: Image.Image) -> npt.NDArray[np.bool_]:
    """Which pixels [H, W] of a mask count: those that are not black; of a lossy format those with a channel above
    MIDDLE. Transparent pixels do not.

    COLMAP and nerfstudio let all count that is not black, and so do masks of zeros and ones, or of the numbers of
    classes, need it: a cut in the middle of the range would leave nothing of them. The compression of a JPEG file
    spreads an edge by several pixels on both sides, as ripples a few levels above black; all of these would count. It
    does not reach the middle, where the edge is.
    """
    if image.mode.startswith(("I", "F")):
        result = np.asarray(image) != 0
    else:
        limit = MIDDLE if image.format in LOSSY else 0
        result = (np.asarray(image.convert("RGB")) > limit).any(-1)
    if has_transparency(image):
        result = result & (np.asarray(image.convert("RGBA"))[..., 3] > 0)
    return result


def has_transparency(image: Image.Image) -> bool:
    """Whether an image has an alpha channel or a transparent colour."""
    return image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info


def in_proportion(mask: tuple[int, int], photograph: tuple[int, int]) -> bool:
    """Whether a mask of this width and height has the proportions of its photograph, so that it can be resized."""
    return abs(mask[0] / mask[1] / (photograph[0] / photograph[1]) - 1.0) <= PROPORTIONS
