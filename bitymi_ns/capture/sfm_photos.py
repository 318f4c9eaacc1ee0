"""Photographs for structure from motion; 360-degree ones are told by metadata or content, not by their aspect ratio."""

import os
import re
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import ExifTags, Image, ImageOps

from bitymi_ns.files import complete_folder
from bitymi_ns.progress import Progress
from bitymi_ns.safe_reading import open_regular, why
from bitymi_ns.trust import is_text, listed
from .exif import Exif, exposure_exif, read_exif
from .folder_contents import open_picture, photographs_below
from .image_files import eight_bits, in_srgb
from .order import natural
from .types import CaptureError, fail, is_full_sphere, scaled_size

PLAIN = {
    "JPEG": (".jpg", ".jpeg"), "PNG": (".png",), "BMP": (".bmp",), "TIFF": (".tif", ".tiff"),
}  # fmt: skip
"""Formats and extensions that COLMAP and nerfstudio read."""
JPEG_QUALITY = 97
IMAGES = "images"  # subfolder of the work folder for upright copies, or a video's frames
COPY = ".jpg"  # appended to a photograph's name for its upright copy
THUMB = 256  # longer side of grey thumbnails, pixels
SHARPNESS_SIZE = 1024  # longer side for measuring sharpness, pixels
BLURRED = 0.5  # largest share of the median sharpness
DUPLICATE_SHIFT = 0.1  # pixels of thumbnails; see `shift`
HEADER = 1 << 17  # bytes searched for metadata
SPHERICAL = re.compile(rb"GPano:ProjectionType|ProjectionType[^a-z]{1,8}(equirectangular|cylindrical)", re.IGNORECASE)
"""XMP entries of panoramas (Google Photo Sphere)."""
ALIKE = 0.6  # least correlation of the details of matching left and right edges
SMOOTH = 15  # rows of the moving average that is no detail
DETAIL = 1.5  # least standard deviation of detail, grey levels: bare edges always match
POLE = 0.35  # largest standard deviation of the first and last row, relative to the picture's


@dataclass(frozen=True)
class Photo:
    name: str  # path relative to the folder, with slashes
    path: Path
    width: int  # upright, as the height
    height: int
    exif: Exif
    plain: bool  # upright, in a format that everything reads
    thumb: np.ndarray  # [h,w] float32 grey levels, longer side THUMB
    sharpness: float  # see `sharpness`
    panorama: bool = False  # a 360-degree picture
    seam: float = 0.0  # see `seam`


def find_photos(folder: Path) -> list[str]:
    """List the photographs in and below a folder in natural order. Raises CaptureError: it cannot be read."""
    try:
        os.listdir(folder)
        paths = list(photographs_below(folder))
    except OSError as error:
        raise CaptureError(f"{folder} cannot be read: {error.strerror}") from error
    return sorted((path.relative_to(folder).as_posix() for path in paths), key=natural)


def check_names(folder: Path, names: Sequence[str]) -> None:
    """Check that names are UTF-8, as COLMAP and JSON need. Raises CaptureError."""
    where = os.path.realpath(folder)
    if wrong := [name for name in (where, *names) if not is_text(name)]:
        advice = "rename it (`convmv -r -f latin1 -t utf8 --notest FOLDER` does so for names in an older encoding)"
        fail(f"in {where}, the name of {listed(wrong, most=1)} is not UTF-8: {advice}")


def read_photos(folder: Path, names: list[str], progress: Progress) -> tuple[list[Photo], dict[str, str]]:
    """Read photographs in threads; return those that can be read, and why the others cannot."""
    photos: list[Photo] = []
    broken: dict[str, str] = {}
    with ThreadPoolExecutor() as pool:
        pending = [pool.submit(read_photo, folder, name) for name in names]
        try:
            for i, (name, result) in enumerate(zip(names, pending, strict=True), 1):
                try:
                    photos.append(result.result())
                except CaptureError as error:
                    broken[name] = str(error)
                progress("reading photographs", i, len(names))
        finally:
            pool.shutdown(cancel_futures=True)
    return photos, broken


def read_photo(folder: Path, name: str) -> Photo:
    """Read a photograph to its last byte. Raises CaptureError, without its name: it cannot be read."""
    path = folder / name
    try:
        with open_picture(path) as image:
            exif = read_exif(image)
            orientation = image.getexif().get(ExifTags.Base.Orientation, 1)
            width, height = image.size[::-1] if orientation in (5, 6, 7, 8) else image.size
            mode, plain = image.mode, is_plain(image, path)
            if image.format == "JPEG":
                image.draft("L", (SHARPNESS_SIZE, SHARPNESS_SIZE))  # decode at a half, a quarter or an eighth
            grey = ImageOps.exif_transpose(eight_bits(image).convert("L"))
            if image.format != "JPEG":  # Pillow turns TIFF by itself, and changes its size
                width, height = grey.size
            frames = getattr(image, "n_frames", 1)
    except MemoryError:
        raise
    except Exception as error:  # decoders raise many kinds on broken files
        fail(f"it cannot be read ({why(error)}): the file is damaged, too large or not an image", error)
    if min(width, height) < 32:
        raise CaptureError(f"it is only {width} x {height} pixels")
    plain = orientation in (0, 1) and plain and frames == 1 and mode in ("L", "RGB", "RGBA", "P")
    thumb = np.asarray(_reduced(grey, THUMB), np.float32)
    detail = np.asarray(_reduced(grey, SHARPNESS_SIZE), np.float32)
    panorama = has_panorama_metadata(path) or looks_panoramic(thumb)
    return Photo(name, path, width, height, exif, plain, thumb, sharpness(detail), panorama, seam(thumb))


def has_panorama_metadata(path: Path) -> bool:
    with suppress(OSError), open_regular(path) as file:
        return SPHERICAL.search(file.read(HEADER)) is not None
    return False


def looks_panoramic(grey: npt.NDArray[np.float32]) -> bool:
    """Test if left and right edge of a reduced grey picture [h, w] continue each other, and the poles are constant."""
    return seam(grey) > ALIKE and bool(max(grey[0].std(), grey[-1].std()) <= POLE * grey.std())


def seam(grey: npt.NDArray[np.float32]) -> float:
    """Correlate the details of the left and right edges; 0 if they are bare, or the picture is no full sphere's."""
    height, width = grey.shape
    if height < 32 or not is_full_sphere(width, height):
        return 0.0
    kernel = np.full(SMOOTH, 1.0 / SMOOTH)
    columns = grey[:, [0, -1]].T.astype(np.float64)
    detail = [column[SMOOTH // 2 : -(SMOOTH // 2)] - np.convolve(column, kernel, "valid") for column in columns]
    return float(np.corrcoef(detail)[0, 1]) if min(each.std() for each in detail) >= DETAIL else 0.0


def is_plain(image: Image.Image, path: Path) -> bool:
    """Test for an opened file in a format that everything reads, with the right extension."""
    return path.suffix.lower() in PLAIN.get(image.format or "", ())


def _reduced(image: Image.Image, side: int) -> Image.Image:
    return image.resize(scaled_size(image.size, min(1.0, side / max(image.size))), Image.Resampling.BOX)


def sharpness(grey: np.ndarray) -> float:
    """Compute the ratio of the root mean squares of Laplacian and gradient of [h,w] float32."""
    right, down = np.diff(grey, axis=1), np.diff(grey, axis=0)
    gradient = float(np.mean(right**2) + np.mean(down**2))
    laplacian = float(np.mean(np.diff(right, axis=1) ** 2) + np.mean(np.diff(down, axis=0) ** 2))
    return float(np.sqrt(laplacian / gradient)) if gradient > 0 else 0.0


def upright(photo: Photo) -> Image.Image:
    """Read a photograph as an upright 8-bit RGB image, with the EXIF of its exposure in `info`."""
    with open_picture(photo.path) as image:
        exposure = exposure_exif(image)
        picture = in_srgb(ImageOps.exif_transpose(eight_bits(image))).convert("RGB")
    picture.info["exif"] = exposure.tobytes()
    return picture


def upright_photos(
    photos: Sequence[Photo], folder: Path, work: Path, progress: Progress
) -> tuple[Path, dict[str, str]]:
    """Write upright JPEG copies of photographs that need one; return the folder to read and the names in it by
    photograph."""
    if all(photo.plain for photo in photos):
        return folder, {photo.name: photo.name for photo in photos}
    names = {photo.name: photo.name if photo.plain else photo.name + COPY for photo in photos}
    target = work / IMAGES
    if not target.is_dir():
        with complete_folder(target) as new:
            for i, photo in enumerate(photos, 1):
                progress("turning photographs upright", i, len(photos))
                path = new / names[photo.name]
                path.parent.mkdir(parents=True, exist_ok=True)
                if photo.plain:
                    there = os.path.realpath(target / names[photo.name])
                    # relative, so that both folders may be moved together
                    path.symlink_to(os.path.relpath(photo.path.resolve(), os.path.dirname(there)))
                else:
                    picture = upright(photo)
                    picture.save(path, quality=JPEG_QUALITY, subsampling=0, exif=picture.info["exif"])
    return target, names


def blurred(photos: Sequence[Photo]) -> list[str]:
    """List photographs with much less fine detail than the median."""
    middle = float(np.median([photo.sharpness for photo in photos]))
    return [photo.name for photo in photos if photo.sharpness < BLURRED * middle]


def duplicates(photos: Sequence[Photo]) -> dict[str, str]:
    """Map near-duplicates to the sharper photograph of the same picture, by name."""
    sharper: dict[str, str] = {}
    kept: list[tuple[float, Photo]] = []
    for photo in sorted(photos, key=lambda photo: -photo.sharpness):
        level, thumb = float(photo.thumb.mean()), photo.thumb
        # duplicates have almost the same mean: compare few pixel by pixel
        near = (twin for mean, twin in kept if abs(mean - level) < 2.0 and twin.thumb.shape == thumb.shape)
        twin = next((twin for twin in near if shift(thumb, twin.thumb) < DUPLICATE_SHIFT), None)
        if twin is not None:
            sharper[photo.name] = twin.name
        else:
            kept.append((level, photo))
    return sharper


def shift(first: np.ndarray, second: np.ndarray) -> float:
    """Estimate the shift, in pixels, of two images [h,w]: root mean square of the difference over the gradient's."""
    gradient = np.mean(np.diff(first, axis=0) ** 2) + np.mean(np.diff(first, axis=1) ** 2)
    difference = np.mean((first - second) ** 2)
    return float(np.sqrt(difference / gradient)) if gradient > 0 else (0.0 if difference == 0 else np.inf)
