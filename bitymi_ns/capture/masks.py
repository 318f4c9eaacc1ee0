"""Masks of photographs: their folder, the mask file of a photograph, and the pixels that count. Structure from motion
and training share these rules."""

import os
from pathlib import Path, PurePosixPath

import numpy as np
import numpy.typing as npt
from PIL import Image

from bitymi_ns.capture.photos import COPY
from bitymi_ns.capture.pictures import DYNAMIC_MASK, PHOTOGRAPHS, open_picture
from bitymi_ns.capture.types import CaptureError

USUAL_FOLDERS = ("images", "input", "image", "photos", "photographs", "rgb", "color")
"""Names of a capture's folder of photographs, the most usual first."""
LOSSY = {"JPEG", "MPO", "WEBP", "JPEG2000", "HEIF", "AVIF"}
"""Lossy formats by Pillow's names, in which black may come back as almost black."""
MIDDLE = 127  # threshold of lossy masks, of 255
PROPORTIONS = 0.02  # relative difference of aspect ratios that counts as rounding


def mask_folder(photographs: Path, data: Path, stated: Path | None = None, downscale: int = 1) -> Path | None:
    """Find the folder of a capture's masks: the stated one; else `masks` beside the folder of the photographs, in that
    folder, or in that of the data, the first of them that is there. A folder of masks that are smaller by `downscale`,
    as `masks_2`, counts, too.

    Beside a folder that is the data, or holds it, lie other things than the capture. There `masks` is used if the
    folder has a usual name for the photographs of a capture: `bed/masks` for `bed/images`, but not `all/masks` for
    `all/bed`.

    Raises:
        CaptureError: the stated one does not exist.
    """
    if stated is not None:
        if not _exists(stated, downscale):
            raise CaptureError(f"the folder of masks {stated} does not exist")
        return stated
    shown, named = Path(os.path.abspath(photographs)), Path(os.path.abspath(data))
    folders = [shown, named]
    if shown.name in USUAL_FOLDERS or not named.is_relative_to(shown):
        folders.insert(0, shown.parent)
    return next((folder / "masks" for folder in folders if _exists(folder / "masks", downscale)), None)


def _exists(masks: Path, downscale: int) -> bool:
    return masks.is_dir() or (downscale > 1 and downscaled_masks(masks, downscale).is_dir())


def downscaled_masks(masks: Path, downscale: int) -> Path:
    """Folder of masks that are smaller by a factor."""
    return masks.with_name(f"{masks.name}_{downscale}")


def mask_of(masks: Path, name: str) -> Path | None:
    """Find the mask of a photograph: its name with .png appended, as COLMAP has it, or its stem with any image suffix,
    as nerfstudio has it. An upright copy has the mask of its photograph."""
    stem = str(PurePosixPath(name).with_suffix(""))
    endings = (".png", *PHOTOGRAPHS)
    candidates = [f"{name}.png", *(stem + ending for ending in endings), f"{name}.PNG"]
    candidates += [stem + ending.upper() for ending in endings]
    found = next((masks / c for c in candidates if (masks / c).is_file()), None)
    is_copy = found is None and name.endswith(COPY) and stem.lower().endswith(PHOTOGRAPHS)
    return mask_of(masks, stem) if is_copy else found


def read_mask(path: Path) -> Image.Image:
    """Read a mask as a 1-bit image, True where pixels count; see `mask_pixels`. In masks of instant-ngp's name it is
    the others that count. Raises Pillow's errors."""
    with open_picture(path) as image:
        return Image.fromarray(mask_pixels(image) ^ path.name.startswith(DYNAMIC_MASK))


def mask_pixels(image: Image.Image) -> npt.NDArray[np.bool_]:
    """Threshold a mask to the pixels [H, W] that count: those that are not black, for lossy formats those with a
    channel above MIDDLE. Transparent pixels do not count.

    COLMAP and nerfstudio count all that is not black, as masks of zeros and ones or of class numbers need it. JPEG
    compression ripples around an edge are a few levels above black, but do not reach MIDDLE.
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
    """Test for an alpha channel or a transparent color."""
    return image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info


def in_proportion(mask: tuple[int, int], photograph: tuple[int, int]) -> bool:
    """Test if a mask (width, height) has the aspect ratio of its photograph, so that it can be resized."""
    return abs(mask[0] / mask[1] / (photograph[0] / photograph[1]) - 1.0) <= PROPORTIONS
