"""Baked scenes for other programs: as 3D Gaussians, and as a textured mesh; and how those would draw them."""

from bitymi_ns.interchange.bundle_cameras import read_cameras
from bitymi_ns.interchange.extras import Frame, Kind, check_extras, extras_folder, summary_line, write_extras

__all__ = [
    "Frame",
    "Kind",
    "check_extras",
    "extras_folder",
    "read_cameras",
    "summary_line",
    "write_extras",
]
