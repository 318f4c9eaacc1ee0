"""Image files: headers, bit depth, color profiles, blank and duplicate photographs."""

import hashlib
import math
from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from io import BytesIO
from pathlib import Path
from typing import NamedTuple, TypeVar

import numpy as np
import numpy.typing as npt
from PIL import EpsImagePlugin, ExifTags, Image, ImageCms

from .exif import exif_stops, exposure_settings
from .folder_contents import open_picture
from .types import Photograph, fail, parsing

S = TypeVar("S")
T = TypeVar("T")
MAX_PIXELS = 1_000_000_000  # of a photograph; phones take some of 200 million
THREADS = 4
PROPORTIONS = 0.02  # relative difference of aspect ratios by rounding
FINGERPRINT_SIZE = 64  # pixels across and down that fingerprints compare
WHITES = ((255.0, 65535.0), (1.0, 255.0))  # usual ones of integers, and of floats
EMPTY: dict[str, Callable[[npt.NDArray[np.uint8]], bool]] = {
    "transparent everywhere": lambda image: image.shape[-1] == 4 and not image[..., 3].any(),
    "of one color throughout": lambda image: bool((image == image[0, 0]).all()),
}


def set_up_pillow() -> None:
    """Raise Pillow's limit to MAX_PIXELS, and disable Ghostscript, which files of any name would start."""
    EpsImagePlugin.gs_binary = False
    Image.MAX_IMAGE_PIXELS = MAX_PIXELS // 2  # Pillow refuses twice as many


def in_threads(function: Callable[[S], T], items: Iterable[S]) -> list[T]:
    with ThreadPoolExecutor(THREADS) as pool:
        return list(pool.map(function, items))


def from_header(path: Path, read: Callable[[Image.Image], T], default: T) -> T:
    """Apply `read` to an undecoded image; return `default` for unreadable files."""
    try:
        with open_picture(path) as image:
            return read(image)
    except Exception:  # Pillow raises many kinds
        return default


def image_size(path: Path) -> tuple[int, int] | None:
    """Read width and height; None for unreadable files."""
    return from_header(path, lambda image: image.size, None)


def file_has_transparency(path: Path) -> bool:
    return from_header(path, has_transparency, False)


def has_transparency(image: Image.Image) -> bool:
    """Test for an alpha channel or a transparent color."""
    return image.mode in ("RGBA", "LA", "PA", "RGBa", "La") or "transparency" in image.info


def in_proportion(mask: tuple[int, int], photograph: tuple[int, int]) -> bool:
    """Test if a mask (width, height) has its photograph's aspect ratio."""
    return abs(mask[0] / mask[1] / (photograph[0] / photograph[1]) - 1.0) <= PROPORTIONS


def exposure_stops(paths: Sequence[Path]) -> list[float]:
    """Compute log2 of the exposure of photographs by EXIF; NaN = unknown, or by other entries than most state. What
    most lack, as the f-number of manual lenses, counts as equal for all."""
    settings = in_threads(lambda path: from_header(path, exposure_settings, ()), paths)
    stated = [tuple(value is not None for value in entry) for entry in settings]
    (usual, _), *_ = Counter(filter(None, stated)).most_common(1) or [((), 0)]
    return [exif_stops(*(value or 1.0 for value in entry)) if entry and entries == usual else math.nan
            for entry, entries in zip(settings, stated, strict=True)]  # fmt: skip


def read_image(path: Path, stored: tuple[int, int] | None = None, wanted: tuple[int, int] | None = None) -> Image.Image:
    """Read a photograph of `stored` size (width, height; None = any) as 8-bit sRGB, mode RGB, or RGBA with
    transparency, reduced to the size `wanted` by pixel averages. Raises CaptureError: it is missing, damaged, or of
    another size."""
    try:
        with parsing(f"the image {path}", _REPLACE, _WORDED), open_picture(path) as file:
            if stored is not None and file.size != stored:
                fail(wrong_size(path, file.size, stored))
            size = file.size
            drafted = None if wanted is None else file.draft(None, (2 * wanted[0], 2 * wanted[1]))
            picture = in_srgb(eight_bits(file))
            picture = picture.convert("RGBA" if has_transparency(file) else "RGB")
            if wanted is None or picture.size == wanted == size:
                return picture
            # decoders round half sizes up: leave out what lies beyond the photograph
            return picture.resize(wanted, Image.Resampling.BOX, drafted[1] if drafted else (0, 0, *size))
    except FileNotFoundError as error:
        fail(f"the image {path} is missing, but the capture has a pose for it", error)
    except Image.DecompressionBombError as error:
        fail(f"{path} has more than {MAX_PIXELS:,} pixels. Make it smaller, and its camera with it.", error)


def eight_bits(image: Image.Image) -> Image.Image:
    """Scale grey of more than 8 bits to 8; keep the EXIF orientation. Raises ValueError: the range is unknown."""
    if not image.mode.startswith(("I", "F")):
        return image
    values = np.asarray(image, dtype=np.float64)
    whites = WHITES[image.mode == "F"]  # TIFF and others do not state theirs
    whites = (65535.0,) if image.mode.startswith("I;16") or image.format == "PNG" else whites
    grey = Image.fromarray(to_bytes(values, whites, "values"))
    turn = Image.Exif()
    turn[ExifTags.Base.Orientation] = image.getexif().get(ExifTags.Base.Orientation, 1)
    grey.info["exif"] = turn.tobytes()
    return grey


def to_bytes(values: npt.NDArray[np.float64], whites: Sequence[float], what: str) -> npt.NDArray[np.uint8]:
    """Scale numbers to bytes; white is the smallest of `whites` that bounds them. Raises ValueError: none does."""
    low, high = float(values.min()), float(values.max())
    white = next((white for white in whites if high <= white), None)
    if white is None or not low >= 0.0:  # also NaN
        raise ValueError(f"its {what} lie between {low:g} and {high:g}, not between 0 and {max(whites):g}")
    return (values * (255.0 / white) + 0.5).astype(np.uint8)


def in_srgb(image: Image.Image) -> Image.Image:
    """Convert an image with a color profile to sRGB."""
    profile = image.info.get("icc_profile")
    convert = _to_srgb(profile, image.mode) if profile and image.mode in ("RGB", "RGBA") else None
    return image if convert is None else convert.apply(image)


@lru_cache(maxsize=8)
def _to_srgb(profile: bytes, mode: str) -> ImageCms.ImageCmsTransform | None:
    """Make the transform of a profile to sRGB for a mode; None = none, or hardly a change."""
    try:
        source = ImageCms.ImageCmsProfile(BytesIO(profile))
        convert = ImageCms.buildTransform(source, ImageCms.createProfile("sRGB"), mode, mode)
    except (ImageCms.PyCMSError, OSError):
        return None
    levels = np.array([0, 64, 128, 192, 255], np.uint8)
    probe = np.stack(np.meshgrid(levels, levels, levels), -1).reshape(5, 25, 3)
    changed = np.asarray(convert.apply(Image.fromarray(probe).convert(mode)), int)[..., :3]
    return convert if np.abs(changed - probe).max() > 4 else None


def pixels_of(image: Image.Image) -> npt.NDArray[np.uint8]:
    """Convert an image to [H, W, 3], or [H, W, 4] if some of it is transparent."""
    pixels = np.array(image, np.uint8)
    opaque = pixels.shape[-1] == 4 and pixels[..., 3].min(initial=255) == 255
    return np.ascontiguousarray(pixels[..., :3]) if opaque else pixels


def check_sizes(photographs: Sequence[Photograph]) -> None:
    """Fail if a photograph has another size than its camera; unreadable ones are reported when they are read."""
    whole = [photograph for photograph in photographs if not photograph.downscaled]
    for photograph, size in zip(whole, in_threads(lambda it: image_size(it.file), whole), strict=True):
        if size not in (None, photograph.camera.size):
            fail(wrong_size(photograph.file, size, photograph.camera.size, photograph.label))


_REPLACE = "Replace it or remove it from the capture."
_WORDED = (FileNotFoundError, Image.DecompressionBombError)


def wrong_size(path: Path | None, size: tuple[int, int], declared: tuple[int, int], camera: str = "its camera") -> str:
    shown = f"{size[0]} x {size[1]} pixels, but {camera} is for {declared[0]} x {declared[1]}"
    if size == declared[::-1]:
        turn = "If an EXIF tag turns it, turn its pixels: `mogrify -auto-orient <photos>`"
        return f"the image {path} is turned by a quarter: it has {shown}. {turn}. Else swap w and h, and cx and cy."
    return f"the image {path} has {shown}. Correct w, h, fl_x, fl_y, cx, cy in the capture, or resize the image."


class ImageSummary(NamedTuple):
    empty: str  # why the photograph is blank; "" = it is not
    fingerprint: bytes  # equal for equal pixels


def summarize(image: npt.NDArray[np.uint8]) -> ImageSummary:
    height, width = image.shape[:2]
    sample = image[:: max(1, height // FINGERPRINT_SIZE), :: max(1, width // FINGERPRINT_SIZE)]
    fingerprint = hashlib.sha256(repr(image.shape).encode() + sample.tobytes()).digest()
    empty = next((what for what, test in EMPTY.items() if test(sample) and test(image)), "")
    return ImageSummary(empty, fingerprint)
