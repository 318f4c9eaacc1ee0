"""Prepare photographs and masks for both COLMAP and nerfstudio."""

import os
import shutil
from collections.abc import Sequence
from pathlib import Path

from PIL import Image

from bitymi_ns.capture.image_files import in_proportion
from bitymi_ns.capture.masks import checked_mask
from bitymi_ns.capture.sfm_photos import COPY, Photo, upright
from bitymi_ns.capture.types import CaptureError
from bitymi_ns.files import complete_folder
from bitymi_ns.progress import Progress

JPEG_QUALITY = 97
IMAGES = "images"  # subfolder of the work folder for upright copies, or a video's frames


def upright_photos(
    photos: Sequence[Photo], folder: Path, work: Path, progress: Progress
) -> tuple[Path, dict[str, str]]:
    """Write upright JPEG copies of the photographs that need one. Return the folder to read (`folder` itself if none
    does, else `images` in the work folder, with links to the others), and the names in it by photograph."""
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
                    # relative, so that both folders may be moved together
                    path.symlink_to(os.path.relpath(photo.path.resolve(), os.path.dirname(there)))
                else:
                    picture = upright(photo)
                    picture.save(path, quality=JPEG_QUALITY, subsampling=0, exif=picture.info["exif"])
            progress("turning photographs upright", len(photos), len(photos))
    return target, names


def emptied(folder: Path) -> Path:
    """Make an empty folder, or empty an existing one."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir()
    return folder


def colmap_mask(path: Path, name: str, size: tuple[int, int]) -> Image.Image:
    """Read the mask of a photograph of this `name` and `size` for COLMAP: grey, of that size."""
    mask = checked_mask(path)
    if not in_proportion(mask.size, size):
        raise CaptureError(
            f"the mask {path} has {mask.width} x {mask.height} pixels, its photograph {name} stands upright with "
            f"{size[0]} x {size[1]}: save it in the same proportions"
        )
    return mask.resize(size, Image.Resampling.NEAREST).convert("L")
