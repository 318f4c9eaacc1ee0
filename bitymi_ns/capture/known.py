"""A point cloud for photographs whose poses are known."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bitymi_ns.capture.types import Progress


@dataclass(frozen=True)
class KnownView:
    """A photograph whose camera is known."""

    name: str
    """Of the file, relative to the folder of the photographs."""
    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    world_to_camera: np.ndarray
    """[3,4] rotation and translation, OpenCV axes (x right, y down, z forward)."""
    distortion: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2 of OpenCV."""


def triangulate(images: Path, views: Sequence[KnownView], progress: Progress | None = None) -> Path:
    """Triangulate points from photographs whose cameras are known; the cameras stay as they are. Kept and continued as
    `find_poses` does.

    Args:
        images: folder that the views' names are relative to.
        views: the photographs with their cameras.
        progress: told the stage and how far it is.

    Returns:
        folder of a COLMAP model (cameras.bin, images.bin, points3D.bin) in the world of the given poses.

    Raises:
        CaptureError: too few points can be found; says what may be wrong.
    """
    raise NotImplementedError
