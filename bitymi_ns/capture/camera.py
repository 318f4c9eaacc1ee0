"""COLMAP cameras as plain values."""

from __future__ import annotations

from typing import NamedTuple

import pycolmap

SPHERICAL_MODEL = "EQUIRECTANGULAR"  # COLMAP camera model of 360-degree pictures; its parameters are width and height
ASPECT = 0.01  # relative difference from aspect ratio 2 that counts as rounding


def is_full_sphere(width: float, height: float) -> bool:
    """Test the shape of a picture of all directions, but for rounding."""
    return abs(width / (2.0 * height) - 1.0) <= ASPECT + 1.0 / height


class ColmapCamera(NamedTuple):
    """Camera: COLMAP camera model, width and height of its pictures in pixels, and parameters in COLMAP's order."""

    model: str
    width: int
    height: int
    params: tuple[float, ...]

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of its pictures, pixels."""
        return self.width, self.height

    @property
    def colmap(self) -> pycolmap.Camera:
        """The camera as pycolmap's object."""
        return pycolmap.Camera(model=self.model, width=self.width, height=self.height, params=list(self.params))

    def rescaled(self, width: int, height: int) -> ColmapCamera:
        """The camera for the same pictures in another size."""
        if (width, height) == self.size:
            return self
        if self.model == SPHERICAL_MODEL:
            return self._replace(width=width, height=height, params=(float(width), float(height)))
        camera = self.colmap
        camera.rescale(width, height)
        return self._replace(width=width, height=height, params=tuple(camera.params))
