"""Read EXIF of photographs, and check what it states."""

import math
import struct
from collections.abc import Mapping
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

from PIL import ExifTags, Image

FULL_FRAME_DIAGONAL = math.hypot(36.0, 24.0)  # millimetres, of focal lengths "in 35 mm film"
SENSOR_ASPECTS = (4 / 3, 3 / 2, 16 / 9, 5 / 4)  # of uncropped photographs
SAME_ASPECT = 0.02  # relative difference by rounding
FOCAL_RANGE = (0.3, 15.0)  # plausible focal lengths in longer sides
STILL = 0.1  # tolerance of the acceleration when held still, g


@dataclass(frozen=True)
class Exif:
    camera: str = ""  # make, model, lens and focal length
    focal_length: float | None = None  # pixels; None = none plausible
    doubt: str = ""  # why a stated focal length is not used
    position: tuple[float, float, float] | None = None  # latitude and longitude in degrees, altitude in metres
    time: str = ""  # sortable; empty = unknown
    up: tuple[float, float, float] | None = None
    """Unit vector away from the ground, in OpenCV axes of the upright photograph."""


def read_exif(image: Image.Image) -> Exif:
    """Read the EXIF of an image not yet turned upright; broken entries count as missing."""
    try:
        tags = image.getexif()
        detail = tags.get_ifd(ExifTags.IFD.Exif)
        gps = tags.get_ifd(ExifTags.IFD.GPSInfo)
    except Exception:  # Pillow raises many kinds on broken EXIF
        return Exif()
    millimetres = number(detail.get(ExifTags.Base.FocalLength))
    names = [tags.get(ExifTags.Base.Make), tags.get(ExifTags.Base.Model), detail.get(ExifTags.Base.LensModel)]
    focal, doubt = focal_length(detail, image.size)
    time, fraction = (str(detail.get(tag) or "").strip()
                      for tag in (ExifTags.Base.DateTimeOriginal, ExifTags.Base.SubsecTimeOriginal))  # fmt: skip
    time = f"{time}.{fraction}" if time and fraction else time
    parts = [str(name).strip("\0 ") for name in names if name] + ([f"{millimetres:g} mm"] if millimetres else [])
    return Exif(" ".join(parts), focal, doubt, _position(gps), time, _up(image, tags, detail))


def focal_length(detail: Mapping[int, Any], size: tuple[int, int]) -> tuple[float | None, str]:
    """Compute the focal length in pixels from the Exif IFD and the stored size, or why a stated one is not used."""
    long, short = max(size), min(size)
    film = number(detail.get(ExifTags.Base.FocalLengthIn35mmFilm))
    millimetres = number(detail.get(ExifTags.Base.FocalLength))
    density = number(detail.get(ExifTags.Base.FocalPlaneXResolution))
    unit = {2: 25.4, 3: 10.0, 4: 1.0}.get(int(number(detail.get(ExifTags.Base.FocalPlaneResolutionUnit)) or 2), 25.4)
    sides = (number(detail.get(tag)) for tag in (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight))
    stated = [side for side in sides if side]
    if not film and not (millimetres and density):
        return None, ""
    if len(stated) == 2:
        if abs(long / short / (max(stated) / min(stated)) - 1) > SAME_ASPECT:
            return None, f"cropped: {long} x {short} pixels of {max(stated):.0f} x {min(stated):.0f}"
    elif density:
        return None, "its pixel density belongs to an image of unknown size"
    if min(abs(long / short / aspect - 1) for aspect in SENSOR_ASPECTS) > SAME_ASPECT:
        return None, f"cropped: no sensor has the aspect of {long} x {short} pixels"
    if film:
        pixels = film / FULL_FRAME_DIAGONAL * math.hypot(long, short)
    else:
        pixels = (millimetres or 0.0) * (density or 0.0) / unit * long / max(stated)
    if not FOCAL_RANGE[0] * long <= pixels <= FOCAL_RANGE[1] * long:
        return None, f"{pixels:.0f} pixels, for an image {long} pixels long"
    return pixels, ""


def number(value: Any) -> float | None:
    """Convert to a positive finite number, else None."""
    with suppress(TypeError, ValueError, ZeroDivisionError, OverflowError):
        return float(value) if 0 < float(value) < math.inf else None
    return None


EXPOSURE = (ExifTags.Base.ExposureTime, ExifTags.Base.FNumber, ExifTags.Base.ISOSpeedRatings)


def exposure_exif(image: Image.Image) -> Image.Exif:
    """Copy the exposure tags of an image to new EXIF, without orientation and position."""
    kept = Image.Exif()
    try:
        detail = image.getexif().get_ifd(ExifTags.IFD.Exif)
        kept.get_ifd(ExifTags.IFD.Exif).update({tag: detail[tag] for tag in EXPOSURE if tag in detail})
        kept.tobytes()
    except Exception:  # Pillow raises many kinds on broken EXIF
        return Image.Exif()
    return kept


def exposure_settings(image: Image.Image) -> tuple[float | None, ...]:
    """Read shutter time (seconds), f-number and ISO; () without a time. Raises any error on broken EXIF."""
    detail = image.getexif().get_ifd(ExifTags.IFD.Exif)
    values = []
    for tag in EXPOSURE:
        value = detail.get(tag)
        if isinstance(value, (tuple, list)):  # several ISO values
            value = value[0] if value else None
        values.append(number(value))
    return tuple(values) if values[0] else ()


def exif_stops(seconds: float, f_number: float, iso: float) -> float:
    """Compute log2 of the exposure."""
    return math.log2(seconds * iso / (f_number * f_number))


def _up(image: Image.Image, tags: Mapping[int, Any], detail: Mapping[int, Any]) -> tuple[float, float, float] | None:
    """Find `Exif.up` by an iPhone's accelerometer; None = none, or it disagrees with the picture's top."""
    note = detail.get(ExifTags.Base.MakerNote)
    if not isinstance(note, bytes) or "front" in str(detail.get(ExifTags.Base.LensModel)).lower():
        return None
    down = apple_acceleration(note)
    if down is None or not abs(math.hypot(*down) - 1) <= STILL:
        return None
    left, bottom, into = (value / math.hypot(*down) for value in down)
    # the sensor's rows run from top to bottom of the phone, its columns from right to left
    turns = {1: (bottom, left), 3: (-bottom, -left), 6: (-left, bottom), 8: (left, -bottom)}
    # Pillow has turned HEIC already
    orientation = image.info.get("original_orientation") or tags.get(ExifTags.Base.Orientation, 1)
    if orientation not in turns:
        return None
    x, y = turns[orientation]
    upright = y < 0 and abs(x) <= -y
    return (x, y, into) if upright or math.hypot(x, y) < 0.5 else None


def apple_acceleration(note: bytes) -> tuple[float, float, float] | None:
    """Parse AccelerationVector (tag 8) of Apple's maker note, in g: axes towards the phone's left side as seen from its
    front, its bottom, and into its face; away from the ground if held still. The note has 14 bytes, "Apple iOS",
    version and "MM", then a big-endian IFD; offsets count from its start."""
    if not note.startswith(b"Apple iOS\0") or note[12:14] != b"MM":
        return None
    with suppress(struct.error, ZeroDivisionError):
        (entries,) = struct.unpack_from(">H", note, 14)
        for i in range(entries):
            tag, kind, count, offset = struct.unpack_from(">HHII", note, 16 + 12 * i)
            if (tag, kind, count) == (8, 10, 3):  # signed rationals
                parts = struct.unpack_from(">6i", note, offset)
                x, y, z = (parts[j] / parts[j + 1] for j in (0, 2, 4))
                return x, y, z
    return None


def _position(gps: Mapping[int, Any]) -> tuple[float, float, float] | None:
    with suppress(KeyError, TypeError, ValueError, ZeroDivisionError):
        angles = []
        for tag, reference in ((2, 1), (4, 3)):
            degrees, minutes, seconds = (float(part) for part in gps[tag])
            angle = degrees + minutes / 60 + seconds / 3600
            angles.append(-angle if str(gps.get(reference, "")).strip("\0 ").upper() in ("S", "W") else angle)
        height = float(gps.get(6, 0.0)) * (-1 if gps.get(5) in (1, b"\x01") else 1)
        if abs(angles[0]) <= 90 and abs(angles[1]) <= 180 and any(angles) and math.isfinite(height):
            return angles[0], angles[1], height
    return None
