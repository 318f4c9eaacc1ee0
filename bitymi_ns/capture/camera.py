"""COLMAP cameras as plain values."""

from __future__ import annotations

from typing import NamedTuple

import pycolmap

from bitymi_ns.capture.panorama_detection import SPHERICAL_MODEL


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
