"""What the EXIF data of photographs say of their exposure."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from PIL.ExifTags import IFD, Base

from bitymi_ns.capture.exif import number
from bitymi_ns.plugin.data.images import THREADS, of_header
from bitymi_ns.train.exposure import exif_stops

TAGS = (Base.ExposureTime, Base.FNumber, Base.ISOSpeedRatings)
"""Shutter time in seconds, f-number and ISO."""
Settings = tuple[float, float, float]


def stops_of(paths: Sequence[Path]) -> list[float]:
    """log2 of the exposure of photographs, by shutter time, aperture and ISO; NaN where it is not known.

    A lens without electronics writes no f-number, and some cameras no ISO: what no photograph has is the same for all.
    Photographs that lack what most have cannot be compared with these.
    """
    with ThreadPoolExecutor(THREADS) as pool:
        settings = list(pool.map(_settings, paths))
    given = Counter(_given(s) for s in settings if s is not None)
    if not given:
        return [math.nan] * len(paths)
    usual = given.most_common(1)[0][0]
    return [math.nan if s is None or _given(s) != usual else exif_stops(*(x or 1.0 for x in s)) for s in settings]


def _given(settings: Settings) -> tuple[bool, ...]:
    return tuple(value > 0.0 for value in settings)


def _settings(path: Path) -> Settings | None:
    """Shutter time, f-number and ISO, 0 for what is not stated; None where the time is not, or nothing can be read."""
    exif = of_header(path, lambda image: image.getexif().get_ifd(IFD.Exif), {})
    values = [_number(exif.get(tag)) for tag in TAGS]
    return (values[0], values[1], values[2]) if values[0] else None


def _number(value: object) -> float:
    """A positive finite number, or 0; of several ISO values the first."""
    if isinstance(value, (tuple, list)):
        value = value[0] if value else None
    return number(value) or 0.0
