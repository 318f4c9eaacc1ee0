"""Photographs and masks as files: read by their bit depth, and what of them there is to learn from."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
from PIL import EpsImagePlugin, Image, UnidentifiedImageError

from bitymi_ns.capture.masks import counted, has_transparency
from bitymi_ns.capture.photos import eight_bits, in_srgb
from bitymi_ns.capture.recognise import open_picture
from bitymi_ns.plugin.console import fail, listed, warn

T = TypeVar("T")
ORIENTATION = 0x0112
"""The EXIF tag that asks viewers to turn a photograph; 1 = as it is stored."""
MOST_PIXELS = 1_000_000_000
"""Photographs with more pixels are refused; phones take some of 200 million."""
THREADS = 4
FINGERPRINT = 64
"""Pixels across, and down, that decide whether two photographs are the same."""


def of_header(path: Path, look: Callable[[Image.Image], T], otherwise: T) -> T:
    """What a look at a photograph's header says, its pixels unread.

    Args:
        path: of the file.
        look: gets the opened file.
        otherwise: the result where there is nothing to read; what is wrong with a file is said where it is read.
    """
    try:
        with open_picture(path) as image:
            return look(image)
    except (OSError, SyntaxError, ValueError, Image.DecompressionBombError):
        return otherwise


def set_up_pillow() -> None:
    """Raise the number of pixels from which Pillow takes a file for an attack, which is 179 million; and have it start
    no Ghostscript, in nerfstudio's readers either, for a file that is PostScript whatever its name says."""
    EpsImagePlugin.gs_binary = False
    Image.MAX_IMAGE_PIXELS = MOST_PIXELS // 2  # PIL refuses twice as many


def check_sizes(paths: Sequence[Path]) -> None:
    """Stop at photographs that are too large to be meant, of which only the headers are read."""
    with ThreadPoolExecutor(THREADS) as pool:
        large = [path for path, too_large in zip(paths, pool.map(_is_too_large, paths), strict=True) if too_large]
    if large:
        fail(
            f"{listed(large)} has more than {MOST_PIXELS:,} pixels. Make it smaller, and w, h, fl_x, fl_y, cx and cy "
            "of its camera with it."
        )


def _is_too_large(path: Path) -> bool:
    try:
        with open_picture(path):
            return False
    except Image.DecompressionBombError:
        return True
    except (OSError, SyntaxError, ValueError):
        return False  # what else is wrong is said where it is read


def read_image(path: Path, stored: tuple[int, int] | None = None, wanted: tuple[int, int] | None = None) -> Image.Image:
    """The photograph with 8 bits per channel, RGB or, where it has transparency, RGBA.

    PIL's own conversion clips what has more bits: a grey picture of 16 bits would come out white. Colours are those of
    screens; see `in_srgb`.

    Args:
        path: of the file.
        stored: width and height that it must have; None = any.
        wanted: width and height to which it will be reduced. A JPEG file may then be decoded at a half, a quarter or an
            eighth of its size, but no smaller than this; that takes a fraction of the time and memory.

    Raises:
        InputError: it is missing, cannot be read, or has another size.
    """
    try:
        with open_picture(path) as file:
            if stored is not None and file.size != stored:
                fail(wrong_size(path, file.size, stored))
            if wanted is not None:
                file.draft(None, wanted)
            picture = in_srgb(eight_bits(file))
            return picture.convert("RGBA" if has_transparency(file) else "RGB")
    except FileNotFoundError as error:
        fail(f"the image {path} is missing, but the capture has a pose for it", error)
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        fail(f"the image {path} cannot be read: {error}. Replace it or remove it from the capture.", error)


def read_mask(path: Path) -> Image.Image:
    """The mask as one channel of truth values; see `counted`."""
    try:
        with open_picture(path) as file:
            return Image.fromarray(counted(file))
    except FileNotFoundError as error:
        fail(f"the mask {path} is missing", error)
    except (UnidentifiedImageError, OSError, SyntaxError, ValueError, Image.DecompressionBombError) as error:
        fail(f"the mask {path} cannot be read: {error}. Replace it, or remove the masks from the capture.", error)


def file_has_transparency(path: Path) -> bool:
    """The same for a file, of which only the header is read; False when there is none to read."""
    return of_header(path, has_transparency, False)


def orientation(path: Path) -> int:
    """How the file asks viewers to turn it, by its EXIF tag; 1 = not at all, also where there is none to read."""

    def look(image: Image.Image) -> int:
        if image.format == "PNG" and "exif" not in image.info:
            return 1  # else PIL would decode the whole image in search of it
        return image.getexif().get(ORIENTATION, 1)

    value = of_header(path, look, 1)
    return value if value in range(1, 9) else 1


def check_orientation(paths: Sequence[Path]) -> None:
    """Say which photographs ask to be turned: they are used as they are stored."""
    with ThreadPoolExecutor(THREADS) as pool:
        turned = [path for path, value in zip(paths, pool.map(orientation, paths), strict=True) if value != 1]
    if turned:
        warn(
            f"{listed(turned)} has an EXIF tag that asks viewers to turn the photograph. It is used as it is stored, "
            "as COLMAP and nerfstudio do. If the pose was made from the turned picture, write the turn into the pixels "
            "(`mogrify -auto-orient <photos>`)."
        )


def wrong_size(path: Path, size: tuple[int, int], declared: tuple[int, int]) -> str:
    """Why a photograph does not fit its camera, and what to do.

    Args:
        path: the photograph.
        size: its width and height in pixels.
        declared: those of its camera.
    """
    shown = f"{size[0]} x {size[1]} pixels, but its camera is for {declared[0]} x {declared[1]}"
    if size == declared[::-1] and orientation(path) >= 5:
        return (
            f"the image {path} is stored turned by a quarter: it has {shown}. Its EXIF tag asks viewers to turn it, "
            "and the camera and pose are for the turned picture. Write the turn into the pixels with "
            "`mogrify -auto-orient <photos>`, or swap w and h (and fl_x and fl_y, cx and cy) and turn the pose."
        )
    return (
        f"the image {path} has {shown}. Correct w and h (and fl_x, fl_y, cx, cy) in the capture, or resize the image."
    )


def masks_without_pixels(paths: Sequence[Path]) -> list[int]:
    """Which of the masks let no pixel count."""
    with ThreadPoolExecutor(THREADS) as pool:
        return [i for i, box in enumerate(pool.map(lambda path: read_mask(path).getbbox(), paths)) if box is None]


class Note(NamedTuple):
    """What is remembered of a photograph once it has been read.

    Attributes:
        empty: why there is nothing to learn from it; "" where there is.
        fingerprint: equal for photographs with the same pixels.
    """

    empty: str
    fingerprint: bytes


def note(image: npt.NDArray[np.uint8]) -> Note:
    """The note on a photograph [H, W, 3 or 4]."""
    height, width = image.shape[:2]
    sample = image[:: max(1, height // FINGERPRINT), :: max(1, width // FINGERPRINT)]
    fingerprint = hashlib.sha256(repr(image.shape).encode() + sample.tobytes()).digest()
    empty = ""
    if _transparent(sample) and _transparent(image):
        empty = "transparent everywhere"
    elif _plain(sample) and _plain(image):
        empty = "of one colour throughout"
    return Note(empty, fingerprint)


def _transparent(image: npt.NDArray[np.uint8]) -> bool:
    return image.shape[-1] == 4 and not image[..., 3].any()


def _plain(image: npt.NDArray[np.uint8]) -> bool:
    return bool((image == image[0, 0]).all())
