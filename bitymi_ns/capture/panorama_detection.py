"""Detection of 360-degree (equirectangular) pictures by metadata or content. An aspect ratio of 2 alone is no evidence:
phones take such photographs, too."""

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt

SPHERICAL_MODEL = "EQUIRECTANGULAR"  # COLMAP camera model of 360-degree pictures; its parameters are width and height
HEADER = 1 << 17  # bytes at the start of a file that are searched for metadata
SPHERICAL = re.compile(rb"GPano:ProjectionType|ProjectionType[^a-z]{1,8}(equirectangular|cylindrical)", re.IGNORECASE)
"""XMP entries of panoramas (Google Photo Sphere)."""
ASPECT = 0.01  # relative difference from aspect ratio 2 that counts as rounding
ALIKE = 0.6  # correlation of the details of the left and right edge from which on they match
SMOOTH = 15  # rows of the moving average that is subtracted to leave the detail
DETAIL = 1.5  # least standard deviation of detail, grey levels: edges of a bare background always match
POLE = 0.35
"""Largest standard deviation of the first and last row, each one point of the sphere, relative to the picture's."""


def has_panorama_metadata(path: Path) -> bool:
    """Test the metadata of a file for a spherical or cylindrical projection."""
    try:
        with open(path, "rb") as file:
            return SPHERICAL.search(file.read(HEADER)) is not None
    except OSError:
        return False


def is_full_sphere(width: float, height: float) -> bool:
    """Test the shape of a picture of all directions, but for rounding."""
    return abs(width / (2.0 * height) - 1.0) <= ASPECT + 1.0 / height


def looks_panoramic(grey: npt.NDArray[np.float32]) -> bool:
    """Test if left and right edge continue each other, and the first and last row are constant, in grey levels [h, w]
    to 255 of the whole picture, reduced to some hundreds of pixels."""
    height, width = grey.shape
    if height < 32 or not is_full_sphere(width, height):
        return False
    if max(grey[0].std(), grey[-1].std()) > POLE * grey.std():
        return False
    kernel = np.full(SMOOTH, 1.0 / SMOOTH)
    columns = grey[:, [0, -1]].T.astype(np.float64)
    detail = [column[SMOOTH // 2 : -(SMOOTH // 2)] - np.convolve(column, kernel, "valid") for column in columns]
    if min(each.std() for each in detail) < DETAIL:
        return False
    return bool(np.corrcoef(detail)[0, 1] > ALIKE)
