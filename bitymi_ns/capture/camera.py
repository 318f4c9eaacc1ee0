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
OPENCV_AXES = np.diag([1.0, -1.0, -1.0, 1.0])  # [4, 4] between camera frames with OpenCV axes and with OpenGL's
SPHERICAL_MODEL = "EQUIRECTANGULAR"  # COLMAP camera model of 360-degree pictures; its parameters are width and height
ASPECT = 0.01  # rounding of the aspect ratio 2 of 360-degree pictures, relative
CAMERA_TYPES = {
    **dict.fromkeys(("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV"), "PERSPECTIVE"),
    "OPENCV_FISHEYE": "FISHEYE", "EQUIRECTANGULAR": "EQUIRECTANGULAR", "FISHEYE624": "FISHEYE624",
    "OMNIDIRECTIONALSTEREO_L": "OMNIDIRECTIONALSTEREO_L", "OMNIDIRECTIONALSTEREO_R": "OMNIDIRECTIONALSTEREO_R",
    "VR180_L": "VR180_L", "VR180_R": "VR180_R", "ORTHOPHOTO": "ORTHOPHOTO",
}  # fmt: skip
"""nerfstudio's camera types by camera_model; the last two lines cannot be trained on."""


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


def colmap_distortion(kind: str, values: Sequence[float], label: str) -> tuple[str, tuple[float, ...]]:
    """Convert nerfstudio's camera type, see CAMERA_TYPES, and its distortion_params to COLMAP's.

    Args:
        values: k1, k2, k3, k4, p1, p2; twelve of FISHEYE624.

    Returns:
        camera model with separate focal lengths, and its parameters after fx, fy, cx, cy (none if SPHERICAL_MODEL).

    Raises:
        CaptureError: COLMAP has no such camera.
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
            f"the camera {label} cannot be used: its k4 is {k4:g}, but perspective cameras have k1 to k3, p1, p2 only. "
            "For a fisheye write camera_model OPENCV_FISHEYE; else undistort first (COLMAP's image_undistorter)."
        )
    if k3 != 0.0:
        return "FULL_OPENCV", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    return ("OPENCV", (k1, k2, p1, p2)) if any((k1, k2, p1, p2)) else ("PINHOLE", ())
