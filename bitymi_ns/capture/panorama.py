"""Pictures that show all directions at once (360 degrees, equirectangular), told by their metadata or their content.

A width of twice the height alone says nothing: phones take such photographs, too.
"""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import numpy.typing as npt

PANORAMAS = (
    "360-degree pictures cannot be trained on as they are. Cut them into perspective views with "
    "`ns-process-data images --camera-type equirectangular`, which finds their poses anew."
)
HEADER = 1 << 17
"""Bytes at the start of a file in which metadata are looked for."""
SPHERICAL = re.compile(rb"GPano:ProjectionType|ProjectionType[^a-z]{1,8}(equirectangular|cylindrical)", re.IGNORECASE)
"""What XMP says of a picture that no single lens took, by Google's description of its entries."""
ASPECT = 0.01
"""Relative difference from a width of twice the height that is rounding."""
ALIKE = 0.6
"""Correlation between the details of the left and the right edge from which on they are one edge."""
SMOOTH = 15
"""Rows over which the mean is taken that is no detail."""
DETAIL = 1.5
"""Grey levels; edges with less detail than this are alike in any picture of a bare background."""
POLE = 0.35
"""A picture of all directions shows one point in its first row, and one in its last: grey levels along these vary by
less than this share of those of the picture."""


def says_so(path: Path) -> bool:
    """Whether a file's metadata say that it is such a picture."""
    try:
        with open(path, "rb") as file:
            return SPHERICAL.search(file.read(HEADER)) is not None
    except OSError:
        return False


def shows_so(grey: npt.NDArray[np.float32]) -> bool:
    """Whether a picture goes on at its left edge where it ends at its right, and its poles are points.

    Args:
        grey: [h, w] grey levels to 255 of the whole picture, reduced to some hundreds of pixels.
    """
    height, width = grey.shape
    if height < 32 or abs(width / (2.0 * height) - 1.0) > ASPECT + 1.0 / height:
        return False
    if max(grey[0].std(), grey[-1].std()) > POLE * grey.std():
        return False
    kernel = np.full(SMOOTH, 1.0 / SMOOTH)
    columns = grey[:, [0, -1]].T.astype(np.float64)
    detail = [column[SMOOTH // 2 : -(SMOOTH // 2)] - np.convolve(column, kernel, "valid") for column in columns]
    if min(each.std() for each in detail) < DETAIL:
        return False
    return bool(np.corrcoef(detail)[0, 1] > ALIKE)
