"""Baked scenes for other programs, as 3D Gaussians and as textured meshes."""

from bitymi_ns.interchange.extras import (
    Frame,
    Kind,
    extras_folder,
    removal_line,
    reserve_extras,
    summary_line,
    training_cameras,
    write_extras,
)

__all__ = [
    "Frame",
    "Kind",
    "extras_folder",
    "removal_line",
    "reserve_extras",
    "summary_line",
    "training_cameras",
    "write_extras",
]
