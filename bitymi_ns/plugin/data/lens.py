"""Lenses: turn photographs of any COLMAP or nerfstudio camera model into pictures of pinhole cameras."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
import pycolmap
from nerfstudio.cameras.cameras import CameraType
from PIL import Image

from bitymi_ns.capture.camera import SPHERICAL_MODEL, ColmapCamera, is_full_sphere
from bitymi_ns.capture.masks import in_proportion
from bitymi_ns.plugin.console import fail, warn
from bitymi_ns.plugin.data.cube_faces import FACES, covered, resample, windows
from bitymi_ns.plugin.data.images import wrong_size

MAX_VIEW_ANGLE = 110.0
"""Largest horizontal and vertical view angle of a pinhole picture, degrees. Wider pictures spend ever more pixels on
ever less of the photograph: wider cameras become faces of a cube."""
NODE_STEP = 4
"""Pixels between the nodes at which the distortion is evaluated; linear interpolation between them is accurate to far
less than a pixel."""
RADIAL_SAMPLES = 32  # samples of each ray that is tested for folding
EDGE_SAMPLES = 64
"""Rays per picture edge for testing what the photograph shows."""
CACHED_MAPS = 4
"""Lenses whose remapping tables are cached; 72 MB for 12 megapixels."""
DOUBTFUL_AREA, ABSURD_AREA = 0.25, 0.05
"""Share of a photograph's area that undistorting leaves, below which to warn or to fail."""


class Pinhole(NamedTuple):
    """Pinhole camera in pixels, with (0, 0) at the upper left corner of the picture."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @property
    def view(self) -> tuple[float, float]:
        """Horizontal and vertical view angle, degrees."""
        across = math.atan(self.cx / self.fx) + math.atan((self.width - self.cx) / self.fx)
        down = math.atan(self.cy / self.fy) + math.atan((self.height - self.cy) / self.fy)
        return math.degrees(across), math.degrees(down)

    @property
    def rays(self) -> npt.NDArray[np.float64]:
        """[H, W, 3] rays through the pixels' centres, of z 1, OpenCV axes."""
        x, y = (np.arange(self.width) + 0.5 - self.cx) / self.fx, (np.arange(self.height) + 0.5 - self.cy) / self.fy
        return np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), -1)


@dataclass(frozen=True)
class Lens:
    """Maps a photograph, or a face of the cube around a wide camera, to the picture of a pinhole camera.

    Attributes:
        camera: of the photograph, in the size to which it is downscaled first.
        stored: width and height of the image file.
        pinhole: camera of the result.
        face: of the cube; empty = the photograph is one picture.
        whole: the photograph covers all of the result; else `coverage` is its mask.
    """

    camera: ColmapCamera
    stored: tuple[int, int]
    pinhole: Pinhole
    face: str = ""
    whole: bool = True

    @property
    def distorts(self) -> bool:
        """True if undistorting moves pixels."""
        return bool(self.face) or _distorts(self.camera.colmap)

    @property
    def turn(self) -> npt.NDArray[np.float64]:
        """[4, 4] rotation of the result's camera axes to the photograph's, both OpenCV's."""
        turn = np.eye(4)
        if self.face:
            turn[:3, :3] = np.array(FACES[self.face]).T
        return turn

    @property
    def coverage(self) -> npt.NDArray[np.bool_]:
        """Pixels [h, w] of the result that the photograph shows."""
        if self.whole:
            return np.ones((self.pinhole.height, self.pinhole.width), bool)
        return covered(self.camera, self.face, self.pinhole.rays)

    def undistort(self, image: Image.Image) -> Image.Image:
        """Undistort an 8-bit image of any mode, decoded at `stored` or less, but not below the size of `camera`."""
        if image.size != self.camera.size:
            image = image.resize(self.camera.size, Image.Resampling.BOX)
        if not self.distorts:
            return image
        return Image.fromarray(self._moved(np.asarray(image), cv2.INTER_LINEAR), image.mode)

    def undistort_mask(self, mask: Image.Image | None, path: Path | None) -> Image.Image:
        """Undistort a mask by nearest neighbors, False where the photograph shows nothing. It may have another size
        than the photograph, but not another aspect ratio; `path` is for the message. None = all of it counts."""
        if mask is None:
            return Image.fromarray(self.coverage)
        pixels = self.undistort_map(np.asarray(mask).astype(np.uint8), path)
        return Image.fromarray(pixels.astype(bool) & self.coverage)

    def undistort_map(self, values: npt.NDArray[Any], path: Path) -> npt.NDArray[Any]:
        """Undistort uint8 or float32 values [H, W] or [H, W, C] by nearest neighbors. They may have another size than
        the photograph, but not another aspect ratio; `path` is for the message."""
        size = (values.shape[1], values.shape[0])
        if not in_proportion(size, self.stored):
            fail(wrong_size(path, size, self.stored))
        values = cv2.resize(values, self.camera.size, interpolation=cv2.INTER_NEAREST_EXACT)
        if self.distorts:
            values = self._moved(values, cv2.INTER_NEAREST)
        return values

    def _moved(self, pixels: npt.NDArray[Any], interpolation: int) -> npt.NDArray[Any]:
        if self.face:
            nearest = interpolation == cv2.INTER_NEAREST
            return resample(pixels, self.camera, self.face, self.pinhole, nearest)
        return cv2.remap(pixels, *_maps(self), interpolation, borderMode=cv2.BORDER_REPLICATE)

    def downscaled(self, factor: float) -> Lens:
        """Return the same lens for pictures scaled by `factor`."""
        of = self.pinhole
        width, height = max(1, round(of.width * factor)), max(1, round(of.height * factor))
        x, y = width / of.width, height / of.height
        pinhole = Pinhole(of.fx * x, of.fy * y, of.cx * x, of.cy * y, width, height)
        camera = self.camera.rescaled(*(max(1, round(side * factor)) for side in self.camera.size))
        return replace(self, camera=camera, pinhole=pinhole)


def lenses_of(colmap: ColmapCamera, stored: tuple[int, int], label: str) -> tuple[list[Lens], list[str]]:
    """Choose the pinhole cameras for a camera: one, or for cameras of more than MAX_VIEW_ANGLE faces of a cube.

    Args:
        colmap: for the size to which photographs are downscaled.
        stored: width and height of the image files, which may be larger.

    Returns:
        the lenses, and messages on what becomes of the photographs.

    Raises:
        InputError: the camera cannot be used.
    """
    model, width, height, params = colmap
    camera = colmap.colmap
    if camera.is_spherical():
        if not is_full_sphere(width, height):
            fail(
                f"{label} is {model}, but its photographs have {width} x {height} pixels: pictures of all directions "
                "are twice as wide as high. Correct the camera model, or pad the photographs to that shape."
            )
        return _faces(colmap, stored, label)
    focal = (camera.focal_length_x, camera.focal_length_y)
    if not np.isfinite(params).all() or min(focal) <= 0.0 or min(width, height) < 1:
        fail(
            f"{label} ({model}, {width} x {height}, {camera.params_to_string()}) cannot be used: its size and focal "
            "lengths have to be positive and all parameters finite. Correct it, or export the model from COLMAP again."
        )
    center = (camera.principal_point_x, camera.principal_point_y)
    if not _distorts(camera):
        pinhole = Pinhole(*focal, *center, width, height)
        return [Lens(colmap, stored, pinhole)], []
    left, right, top, bottom = _window(colmap)
    w, h = int((left + right) * focal[0]), int((top + bottom) * focal[1])
    share = w * h / (width * height)
    if share < ABSURD_AREA or min(w, h) < 1:
        fail(
            f"the lens distortion of {label} is absurd: with {model} {camera.params_to_string()} undistorting would "
            f"leave {100.0 * share:.2g} % of the picture. Correct the numbers, or calibrate again with a simpler model "
            "(SIMPLE_RADIAL)."
        )
    if share < DOUBTFUL_AREA:
        warn(f"Undistorting leaves only {100.0 * share:.2g} % of {label}. The lens distortion may be wrong.")
    pinhole = Pinhole(*focal, left * focal[0], top * focal[1], w, h)
    across, down = pinhole.view
    if max(across, down) > MAX_VIEW_ANGLE - 0.5:
        return _faces(colmap, stored, label)
    messages = []
    if camera.is_perspective_fisheye():
        messages.append(
            f"{label} is {model}: its photographs are used as pinhole pictures of {across:.0f} x {down:.0f} degrees "
            f"({w} x {h} pixels); what they show beyond is not used."
        )
    return [Lens(colmap, stored, pinhole)], messages


def _faces(colmap: ColmapCamera, stored: tuple[int, int], label: str) -> tuple[list[Lens], list[str]]:
    """Lenses of the faces of the cube that a wide camera covers, with its focal length; see `lenses_of`."""
    camera = colmap.colmap
    around = colmap.width / (2.0 * math.pi)
    fx, fy = (around, around) if camera.is_spherical() else (camera.focal_length_x, camera.focal_length_y)
    lenses = []
    for face, (left, right, top, bottom, whole) in windows(colmap).items():
        w, h = max(1, round((right - left) * fx)), max(1, round((bottom - top) * fy))
        u, v = w / (right - left), h / (bottom - top)
        lenses.append(Lens(colmap, stored, Pinhole(u, v, -left * u, -top * v, w, h), face, whole))
    named = ", ".join(f"{lens.face} {lens.pinhole.width} x {lens.pinhole.height}" for lens in lenses)
    return lenses, [
        f"{label} is {colmap.model}: each of its photographs becomes {len(lenses)} pinhole pictures ({named})."
    ]


def colmap_distortion(kind: CameraType, values: Sequence[float], label: str) -> tuple[str, tuple[float, ...]]:
    """Convert nerfstudio's camera type and distortion_params (k1, k2, k3, k4, p1, p2; FISHEYE624: 12) to COLMAP's.

    Returns:
        COLMAP camera model with separate focal lengths, and its parameters after fx, fy, cx, cy; for
        equirectangular ones SPHERICAL_MODEL and none.

    Raises:
        InputError: there is no such COLMAP camera.
    """
    if kind == CameraType.EQUIRECTANGULAR:
        return SPHERICAL_MODEL, ()
    if kind not in (CameraType.PERSPECTIVE, CameraType.FISHEYE, CameraType.FISHEYE624):
        fail(
            f"the camera {label} cannot be used: it is neither a perspective, a fisheye nor an equirectangular camera, "
            f"which are the kinds that can be trained on, but {kind.name}. Correct the capture."
        )
    counts, needs = {
        CameraType.PERSPECTIVE: ((6,), "perspective cameras need six: k1, k2, k3, k4, p1, p2"),
        CameraType.FISHEYE: ((4, 6), "fisheye cameras need four: k1, k2, k3, k4"),
        CameraType.FISHEYE624: ((12,), "FISHEYE624 needs twelve"),
    }[kind]
    if len(values) not in counts:
        fail(f"the camera {label} has {len(values)} distortion_params; {needs}. Correct the capture.")
    if kind == CameraType.FISHEYE624:
        return "RAD_TAN_THIN_PRISM_FISHEYE", tuple(values)
    if kind == CameraType.FISHEYE:
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


def _distorts(camera: pycolmap.Camera) -> bool:
    # pycolmap tests the coefficients alone, of which fisheye models need none
    return camera.is_perspective_fisheye() or not camera.is_undistorted()


def _window(camera: ColmapCamera) -> tuple[float, float, float, float]:
    """Largest extent of the pinhole picture to the left, right, top and bottom of the axis, in focal lengths.

    It shows nothing that the photograph does not: neither beyond its edges, nor where the model folds the picture. Each
    side is maximized on its own, then all are scaled until the corners fit, too.
    """
    most = math.tan(math.radians(0.5 * MAX_VIEW_ANGLE))
    reach = np.zeros(4)
    for side, direction in enumerate(((-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0))):
        reach[side] = most * _largest(lambda s, d=direction: _is_seen(camera, s * most * np.array([d])))

    def border(scale: float) -> npt.NDArray[np.float64]:
        left, right, top, bottom = scale * reach
        t = np.linspace(0.0, 1.0, EDGE_SAMPLES)
        x, y = -left + t * (left + right), -top + t * (top + bottom)
        edges = [(x, np.full_like(t, -top)), (x, np.full_like(t, bottom))]
        edges += [(np.full_like(t, -left), y), (np.full_like(t, right), y)]
        return np.concatenate([np.stack(edge, -1) for edge in edges])

    left, right, top, bottom = reach * _largest(lambda s: _is_seen(camera, border(s)))
    return left, right, top, bottom


def _largest(fits: Callable[[float], bool]) -> float:
    """Bisect for the largest number in [0, 1] that fits, where all smaller ones fit."""
    if fits(1.0):
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(24):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


def _is_seen(camera: ColmapCamera, rays: npt.NDArray[np.float64]) -> bool:
    """Test that the photograph shows all rays (x, y, 1), [N, 2], and that pixels move outwards along each of them."""
    lens, t = camera.colmap, np.linspace(0.0, 1.0, RADIAL_SAMPLES + 1)[1:]
    points = (t[:, None, None] * rays).reshape(-1, 2)
    pixels = lens.img_from_cam(np.concatenate([points, np.ones((len(points), 1))], 1)).reshape(len(t), -1, 2)
    if not np.isfinite(pixels).all():
        return False
    inside = (pixels >= 0.0).all() and (pixels <= camera.size).all()
    away = np.linalg.norm(pixels - (lens.principal_point_x, lens.principal_point_y), axis=-1)
    return bool(inside and (np.diff(away, axis=0) > 0.0).all())


@lru_cache(maxsize=CACHED_MAPS)
def _maps(lens: Lens) -> tuple[npt.NDArray[np.int16], npt.NDArray[np.uint16]]:
    """Position in the photograph of each pixel of the result, as fixed-point maps for cv2.remap."""
    to = lens.pinhole
    x, y = (np.arange(0, size + NODE_STEP, NODE_STEP) + 0.5 for size in (to.width, to.height))
    rays = np.stack(np.meshgrid((x - to.cx) / to.fx, (y - to.cy) / to.fy), -1).reshape(-1, 2)
    nodes = lens.camera.colmap.img_from_cam(np.concatenate([rays, np.ones((len(rays), 1))], 1)) - 0.5
    nodes = nodes.reshape(len(y), len(x), 2).astype(np.float32)
    scale = np.array([[1.0 / NODE_STEP, 0.0, 0.0], [0.0, 1.0 / NODE_STEP, 0.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    whole = cv2.warpAffine(nodes, scale, (to.width, to.height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return cv2.convertMaps(whole, None, cv2.CV_16SC2)
