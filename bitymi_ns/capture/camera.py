"""Photographs, and their cameras as COLMAP's plain values."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pycolmap

from bitymi_ns.capture.types import MapFiles

Pose = npt.NDArray[np.float64]
OPENCV_AXES = np.diag([1.0, -1.0, -1.0, 1.0])  # [4, 4] between camera frames with OpenCV axes and with OpenGL's
SPHERICAL_MODEL = "EQUIRECTANGULAR"  # COLMAP camera model of 360-degree pictures; its parameters are width and height
ASPECT = 0.01  # rounding of the aspect ratio 2 of 360-degree pictures, relative


def is_full_sphere(width: float, height: float) -> bool:
    """Test for the aspect ratio of a 360-degree picture, up to rounding."""
    return abs(width / (2.0 * height) - 1.0) <= ASPECT + 1.0 / height


class ColmapCamera(NamedTuple):
    """Camera model of COLMAP, width and height of the pictures in pixels, and parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height, pixels."""
        return self.width, self.height

    @property
    def colmap(self) -> pycolmap.Camera:
        """pycolmap's camera."""
        return pycolmap.Camera(model=self.model, width=self.width, height=self.height, params=list(self.params))

    def rescaled(self, width: int, height: int) -> ColmapCamera:
        """Return the camera for the same pictures in another size."""
        if (width, height) == self.size:
            return self
        if self.model == SPHERICAL_MODEL:
            return self._replace(width=width, height=height, params=(float(width), float(height)))
        camera = self.colmap
        camera.rescale(width, height)
        return self._replace(width=width, height=height, params=tuple(camera.params))


@dataclass(frozen=True)
class Photograph:
    """A photograph with its camera."""

    file: Path
    camera: ColmapCamera  # in pixels before downscaling
    pose: Pose  # [4, 4] float64, camera to world, OpenGL axes (camera: x right, y up, z backward)
    label: str  # names the camera in messages
    mask: Path | None = None
    downscaled: bool = False  # `file` is a downscaled copy
    frame: int | None = None  # shared by photographs that a rig took together; None = it stands alone
    maps: MapFiles = MapFiles()
