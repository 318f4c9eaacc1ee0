"""Baked scenes for other programs, as 3D Gaussians and as textured meshes, with renderers to measure them."""

from bitymi_ns.interchange.extras import (
    Frame,
    Kind,
    extras_folder,
    removal_line,
    reserve_extras,
    summary_line,
    write_extras,
)
from bitymi_ns.interchange.held_out import read_held_out, training_cameras

__all__ = [
    "Frame",
    "Kind",
    "extras_folder",
    "read_held_out",
    "removal_line",
    "reserve_extras",
    "summary_line",
    "training_cameras",
    "write_extras",
]
