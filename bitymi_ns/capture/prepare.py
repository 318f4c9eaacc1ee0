"""Photographs and masks in forms that both COLMAP and nerfstudio read."""

import os
from collections.abc import Iterable, Sequence
from pathlib import Path

from PIL import Image

from bitymi_ns.capture.masks import in_proportion, mask_of, mask_pixels
from bitymi_ns.capture.photos import COPY, Photo, upright
from bitymi_ns.capture.recognise import open_picture
from bitymi_ns.capture.types import CaptureError
from bitymi_ns.files import complete_file, complete_folder
from bitymi_ns.progress import Progress

JPEG_QUALITY = 97
IMAGES = "images"  # subfolder of the work folder for upright copies, or the frames of a video


def upright_photos(
    photos: Sequence[Photo], folder: Path, work: Path, progress: Progress
) -> tuple[Path, dict[str, str]]:
    """Make a folder in which every photograph is upright and in a format that everything reads.

    Args:
        photos: the photographs to be used.
        folder: the one they stand in.
        work: gets `images` where some have to be converted; the others are links in it.

    Returns:
        the folder, which is `folder` itself where no photograph needs a copy, and the names in it by photograph.
    """
    if all(photo.plain for photo in photos):
        return folder, {photo.name: photo.name for photo in photos}
    names = {photo.name: photo.name if photo.plain else photo.name + COPY for photo in photos}
    target = work / IMAGES
    if not target.is_dir():
        with complete_folder(target) as new:
            for i, photo in enumerate(photos):
                progress("turning photographs upright", i, len(photos))
                path = new / names[photo.name]
                path.parent.mkdir(parents=True, exist_ok=True)
                if photo.plain:
                    there = os.path.realpath(target / names[photo.name])
                    path.symlink_to(os.path.relpath(photo.path.resolve(), os.path.dirname(there)))  # may move together
                else:
                    picture = upright(photo)
                    picture.save(path, quality=JPEG_QUALITY, subsampling=0, exif=picture.info["exif"])
            progress("turning photographs upright", len(photos), len(photos))
    return target, names


def colmap_masks(photos: Iterable[Photo], names: dict[str, str], masks: Path, work: Path) -> Path:
    """Write the masks as COLMAP reads them, grey PNGs of the size of the upright photographs, and return their folder.

    A photograph without a mask is used as a whole.

    Args:
        photos: the photographs.
        names: what COLMAP calls each.
        masks: folder of the masks.
        work: gets the folder.

    Raises:
        CaptureError: a mask cannot be read, or has another aspect than its photograph, or there is none at all.
    """
    target = work / "masks"
    found = [(photo, path) for photo in photos if (path := mask_of(masks, photo.name)) is not None]
    if not found:
        raise CaptureError(
            f"no mask in {masks} belongs to a photograph: give them the photographs' names, as photo.png for photo.jpg"
        )
    target.mkdir(exist_ok=True)
    for photo, path in found:
        with complete_file(target / f"{names[photo.name]}.png") as file:
            _read_mask(path, photo).save(file, "PNG")
    return target


def _read_mask(path: Path, photo: Photo) -> Image.Image:
    try:
        with open_picture(path) as image:
            mask = Image.fromarray(mask_pixels(image))
    except Exception as error:
        raise CaptureError(f"the mask {path} cannot be read: save it anew, or remove it") from error
    size = (photo.width, photo.height)
    if not in_proportion(mask.size, size):
        raise CaptureError(
            f"the mask {path} has {mask.width} x {mask.height} pixels, its photograph {photo.name} stands upright with "
            f"{photo.width} x {photo.height}: save it in the same proportions"
        )
    return mask.resize(size, Image.Resampling.NEAREST).convert("L")
