"""Cameras of photographs: COLMAP's as plain values, and nerfstudio's converted to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
import pycolmap

from bitymi_ns.capture.types import MapFiles, fail

Pose = npt.NDArray[np.float64]
OPENCV_AXES = np.diag([1.0, -1.0, -1.0, 1.0])
"""[4, 4] between camera frames with OpenCV axes and with OpenGL's."""
SPHERICAL_MODEL = "EQUIRECTANGULAR"  # COLMAP camera model of 360-degree pictures; its parameters are width and height
ASPECT = 0.01  # relative difference from aspect ratio 2 that counts as rounding
CAMERA_TYPES = {
    **dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), "PERSPECTIVE"),
    "OPENCV_FISHEYE": "FISHEYE", "EQUIRECTANGULAR": "EQUIRECTANGULAR", "FISHEYE624": "FISHEYE624",
    "OMNIDIRECTIONALSTEREO_L": "OMNIDIRECTIONALSTEREO_L", "OMNIDIRECTIONALSTEREO_R": "OMNIDIRECTIONALSTEREO_R",
    "VR180_L": "VR180_L", "VR180_R": "VR180_R", "ORTHOPHOTO": "ORTHOPHOTO",
}  # fmt: skip
"""nerfstudio's types of cameras by their camera_model; those of the last two lines cannot be trained on."""


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


@dataclass(frozen=True)
class Photograph:
    """A photograph with its camera."""

    file: Path  # image file
    camera: ColmapCamera  # in pixels of the photograph before any downscaling
    pose: Pose  # [4, 4] float64, camera to world, OpenGL axes (camera: x right, y up, z backward)
    label: str  # names the camera in messages
    mask: Path | None = None  # mask file; None = none
    downscaled: bool = False  # `file` is a copy that is downscaled already
    frame: int | None = None  # number that photographs share which a rig took together; None = it stands alone
    maps: MapFiles = MapFiles()  # depth and normals


def colmap_distortion(kind: str, values: Sequence[float], label: str) -> tuple[str, tuple[float, ...]]:
    """Convert nerfstudio's type of camera, see CAMERA_TYPES, and distortion_params (k1, k2, k3, k4, p1, p2; FISHEYE624:
    12) to COLMAP's.

    Returns:
        COLMAP camera model with separate focal lengths, and its parameters after fx, fy, cx, cy; for
        equirectangular ones SPHERICAL_MODEL and none.

    Raises:
        CaptureError: there is no such COLMAP camera.
    """
    if kind == "EQUIRECTANGULAR":
        return SPHERICAL_MODEL, ()
    if kind not in ("PERSPECTIVE", "FISHEYE", "FISHEYE624"):
        fail(
            f"the camera {label} cannot be used: it is neither a perspective, a fisheye nor an equirectangular camera, "
            f"which are the kinds that can be trained on, but {kind}. Correct the capture."
        )
    counts, needs = {
        "PERSPECTIVE": ((6,), "perspective cameras need six: k1, k2, k3, k4, p1, p2"),
        "FISHEYE": ((4, 6), "fisheye cameras need four: k1, k2, k3, k4"),
        "FISHEYE624": ((12,), "FISHEYE624 needs twelve"),
    }[kind]
    if len(values) not in counts:
        fail(f"the camera {label} has {len(values)} distortion_params; {needs}. Correct the capture.")
    if kind == "FISHEYE624":
        return "RAD_TAN_THIN_PRISM_FISHEYE", tuple(values)
    if kind == "FISHEYE":
        return "OPENCV_FISHEYE", tuple(values[:4])
    k1, k2, k3, k4, p1, p2 = values
    if k4 != 0.0:
        fail(
            f"the camera {label} cannot be used: its k4 is {k4:g}, but perspective cameras are undistorted by k1, k2, "
            "k3, p1 and p2 alone. For a fisheye write camera_model OPENCV_FISHEYE; else undistort the photographs "
            "first (COLMAP's image_undistorter)."
        )
    if k3 != 0.0:
        return "FULL_OPENCV", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    return ("OPENCV", (k1, k2, p1, p2)) if any((k1, k2, p1, p2)) else ("PINHOLE", ())
