"""Which photographs of a set are blurred, and which show what another one shows."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bitymi_ns.capture.photos import Photo

BLURRED = 0.5
"""A photograph is blurred if its sharpness is below this share of the set's median."""
DUPLICATE_SHIFT = 0.1
"""Two photographs are duplicates if they differ by less than a shift by this many pixels of their thumbnails."""


def blurred(photos: Sequence[Photo]) -> list[str]:
    """Names of photographs with clearly less fine detail than the set has as a rule."""
    if len(photos) < 3:
        return []
    middle = float(np.median([photo.sharpness for photo in photos]))
    return [photo.name for photo in photos if photo.sharpness < BLURRED * middle]


def duplicates(photos: Sequence[Photo]) -> dict[str, str]:
    """Photographs that show what another one shows, by the name of that one: the sharper of the two stays.

    The difference of two thumbnails over their gradient is the shift in pixels that would explain it.
    """
    found: dict[str, str] = {}
    for shape in {photo.thumb.shape for photo in photos}:
        same = sorted((p for p in photos if p.thumb.shape == shape), key=lambda p: -p.sharpness)
        kept: list[Photo] = []
        means = np.empty(0)
        for photo in same:
            level = float(photo.thumb.mean())
            # A duplicate has almost the same mean, so few are compared pixel by pixel.
            near = [kept[i] for i in np.flatnonzero(np.abs(means - level) < 2.0)]
            twin = next((other for other in near if shift(photo.thumb, other.thumb) < DUPLICATE_SHIFT), None)
            if twin is not None:
                found[photo.name] = twin.name
            else:
                kept.append(photo)
                means = np.append(means, level)
    return found


def shift(first: np.ndarray, second: np.ndarray) -> float:
    """Root mean square difference of two images over that of their gradient, in pixels.

    Args:
        first, second: [h,w] float32 grey levels.
    """
    gradient = np.mean(np.diff(first, axis=0) ** 2) + np.mean(np.diff(first, axis=1) ** 2)
    difference = np.mean((first - second) ** 2)
    return float(np.sqrt(difference / gradient)) if gradient > 0 else (0.0 if difference == 0 else np.inf)
