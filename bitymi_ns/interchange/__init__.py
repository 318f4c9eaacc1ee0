"""Baked scenes for other programs: as 3D Gaussians, and as a textured mesh; and how those would draw them."""

from bitymi_ns.interchange.bundle_cameras import Given, given_with
from bitymi_ns.interchange.extras import (
    FILES,
    Frame,
    Kind,
    Written,
    check_extras,
    described,
    place_of,
    write_extras,
)

__all__ = [
    "FILES",
    "Frame",
    "Given",
    "Kind",
    "Written",
    "check_extras",
    "described",
    "given_with",
    "place_of",
    "write_extras",
]
