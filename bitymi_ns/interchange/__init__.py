"""Baked scenes for other programs: as 3D Gaussians, and as a textured mesh; and how those would draw them."""

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
from bitymi_ns.interchange.given import Given, given_with

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
