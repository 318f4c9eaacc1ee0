"""Resample photographs of any COLMAP or nerfstudio camera model to pinhole pictures."""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
import numpy.typing as npt
from PIL import Image

from bitymi_ns.trust import listed
from .image_files import image_size, in_proportion, in_threads, wrong_size
from .types import SPHERICAL_MODEL, ColmapCamera, Photograph, fail, is_full_sphere, say, scaled_size

MAX_VIEW_ANGLE = 110.0  # degrees, across and down; wider pictures waste pixels
NODE_STEP = 4  # pixels between nodes of the distortion; interpolation is far more exact than a pixel
EDGE_SAMPLES = 64  # rays per picture edge for testing coverage
FACES: dict[str, tuple[tuple[float, float, float], ...]] = {
    "front": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "right": ((0.0, 0.0, -1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)),
    "back": ((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0)),
    "left": ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)),
    "up": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
    "down": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
}
"""Right, down and forward of each face of 90 x 90 degrees, in the photograph's camera axes (OpenCV)."""
MAX_ANGLE = math.radians(89.9)  # largest angle to the axis; COLMAP's fisheye models end before 90 degrees
NODES = 361  # rays along a side of a face for testing coverage
LEAST_SHARE = 0.05  # least covered share of a face: others are strips at the edge
ANGLES, AZIMUTHS = 360, 64  # rays for testing where distortion folds the picture
SAMPLES = 2  # along a side of a face's pixel: one aliases where photographs are denser, as at their poles
BAND = 256  # rows of a face that are resampled together
PAD = 2  # columns by which 360-degree pictures are continued at each side
NO_MAP = np.empty(0, np.float32)  # where OpenCV's first map has both coordinates
CACHED_MAPS = 4  # lenses; 72 MB for 12 megapixels
ABSURD_AREA = 0.05  # least share of a photograph that undistorting leaves


class Pinhole(NamedTuple):
    """Camera in pixels, (0, 0) at the picture's upper left corner."""

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
        x = (np.arange(self.width) + 0.5 - self.cx) / self.fx
        y = (np.arange(self.height) + 0.5 - self.cy) / self.fy
        return _through(x, y[:, None])


def _through(x: npt.ArrayLike, y: npt.ArrayLike) -> npt.NDArray[np.float64]:
    """Make the rays [..., 3] through the points (x, y, 1)."""
    return np.stack(np.broadcast_arrays(x, y, 1.0), -1)


@dataclass(frozen=True)
class Lens:
    """Resampling of a photograph, or of a cube face around a wide camera, to a pinhole picture."""

    camera: ColmapCamera  # of the photograph, in the size it is downscaled to first
    stored: tuple[int, int]  # width and height of the image file
    pinhole: Pinhole  # camera of the result
    face: str = ""  # of the cube; empty = one picture
    whole: bool = True  # the photograph covers the whole result

    @property
    def distorts(self) -> bool:
        """True if undistorting moves pixels."""
        camera = self.camera.colmap  # pycolmap tests coefficients; fisheyes distort without any
        return bool(self.face) or camera.is_perspective_fisheye() or not camera.is_undistorted()

    @property
    def turn(self) -> npt.NDArray[np.float64]:
        """[4, 4] rotation of the result's camera axes to the photograph's, both OpenCV's."""
        turn = np.eye(4)
        turn[:3, :3] = np.array(FACES[self.face or "front"]).T
        return turn

    @property
    def coverage(self) -> npt.NDArray[np.bool_]:
        """Pixels [h, w] of the result that the photograph shows."""
        if self.whole:
            return np.ones((self.pinhole.height, self.pinhole.width), bool)
        return covered(self.camera, self.face, self.pinhole.rays)

    def name(self, photograph: Path) -> Path:
        """Name the view of a photograph."""
        return photograph.with_stem(f"{photograph.stem}-{self.face}") if self.face else photograph

    def undistort(self, image: Image.Image) -> Image.Image:
        """Undistort an 8-bit image of any mode, decoded at a size between those of `stored` and `camera`."""
        if image.size != self.camera.size:
            image = image.resize(self.camera.size, Image.Resampling.BOX)
        if not self.distorts:
            return image
        return Image.fromarray(self._moved(np.asarray(image), cv2.INTER_LINEAR), image.mode)

    def undistort_mask(self, mask: Image.Image | None, path: Path | None) -> Image.Image:
        """Undistort a mask, False outside the photograph; None = everything counts. See `undistort_map`."""
        if mask is None:
            return Image.fromarray(self.coverage)
        pixels = self.undistort_map(np.asarray(mask).astype(np.uint8), path)
        return Image.fromarray(pixels.astype(bool) & self.coverage)

    def undistort_map(self, values: npt.NDArray[Any], path: Path | None) -> npt.NDArray[Any]:
        """Undistort uint8 or float32 values [H, W] or [H, W, C], of any size in proportion, by nearest neighbors."""
        size = (values.shape[1], values.shape[0])
        if not in_proportion(size, self.stored):
            fail(wrong_size(path, size, self.stored))
        values = cv2.resize(values, self.camera.size, interpolation=cv2.INTER_NEAREST_EXACT)
        return self._moved(values, cv2.INTER_NEAREST) if self.distorts else values

    def _moved(self, pixels: npt.NDArray[Any], interpolation: int) -> npt.NDArray[Any]:
        if self.face:
            return self._resampled(pixels, interpolation == cv2.INTER_NEAREST)
        return cv2.remap(pixels, *_maps(self), interpolation, borderMode=cv2.BORDER_REPLICATE)

    def _resampled(self, pixels: npt.NDArray[Any], nearest: bool) -> npt.NDArray[Any]:
        to, lens = self.pinhole, self.camera.colmap
        samples = 1 if nearest else SAMPLES
        how = cv2.INTER_NEAREST if nearest else cv2.INTER_CUBIC  # linear blurs: 1 dB on a ray-traced room
        pad = PAD if lens.is_spherical() else 0
        if pad:
            pixels = cv2.copyMakeBorder(pixels, 0, 0, pad, pad, cv2.BORDER_WRAP)
        x = ((np.arange(to.width * samples) + 0.5) / samples - to.cx) / to.fx
        bands = []
        for start in range(0, to.height, BAND):
            rows = min(BAND, to.height - start)
            y = (start + (np.arange(rows * samples) + 0.5) / samples - to.cy) / to.fy
            rays = _through(x, y[:, None]).reshape(-1, 3) @ FACES[self.face]
            positions = self.camera.pixels_of(rays).astype(np.float32).reshape(len(y), len(x), 2)
            positions += np.array([pad - 0.5, -0.5], np.float32)
            band = cv2.remap(pixels, positions, NO_MAP, how, borderMode=cv2.BORDER_REPLICATE)
            bands.append(band if nearest else cv2.resize(band, (to.width, rows), interpolation=cv2.INTER_AREA))
        return np.concatenate(bands)

    def downscaled(self, factor: float) -> Lens:
        whole = self.pinhole
        width, height = scaled_size((whole.width, whole.height), factor)
        x, y = width / whole.width, height / whole.height
        pinhole = Pinhole(whole.fx * x, whole.fy * y, whole.cx * x, whole.cy * y, width, height)
        return replace(self, camera=self.camera.rescaled(*scaled_size(self.camera.size, factor)), pinhole=pinhole)


def lenses_of(colmap: ColmapCamera, stored: tuple[int, int], label: str) -> list[Lens]:
    """Choose the pinhole picture of a camera, for the size to which photographs are downscaled, or cube faces if it is
    wider than MAX_VIEW_ANGLE. `stored`: size of the files. Raises CaptureError: the camera cannot be used."""
    model, width, height, params = colmap
    camera = colmap.colmap
    if camera.is_spherical():
        if not is_full_sphere(width, height):
            what = f"{label} is {model}, which is twice as wide as high, but its photographs have {width} x {height}"
            fail(f"{what} pixels. Correct the camera model, or pad the photographs to that shape.")
        return _faces(colmap, stored)
    focal = (camera.focal_length_x, camera.focal_length_y)
    if not np.isfinite(params).all() or min(focal) <= 0.0 or min(width, height) < 1:
        what = f"{label} ({model}, {width} x {height}, {camera.params_to_string()}) cannot be used"
        fail(f"{what}: size and focal lengths have to be positive, all numbers finite. Correct it.")
    center = (camera.principal_point_x, camera.principal_point_y)
    lens = Lens(colmap, stored, Pinhole(*focal, *center, width, height))
    if not lens.distorts:
        return [lens]
    left, right, top, bottom = _window(colmap)
    w, h = int((left + right) * focal[0]), int((top + bottom) * focal[1])
    share = w * h / (width * height)
    if share < ABSURD_AREA or min(w, h) < 1:
        what = f"{model} {camera.params_to_string()} would leave {100.0 * share:.2g} % of the picture"
        fail(f"the lens distortion of {label} is absurd: {what}. Correct it, or calibrate a SIMPLE_RADIAL camera.")
    pinhole = Pinhole(*focal, left * focal[0], top * focal[1], w, h)
    wide = max(pinhole.view) > MAX_VIEW_ANGLE - 0.5
    return _faces(colmap, stored) if wide else [replace(lens, pinhole=pinhole)]


def make_lenses(photographs: Sequence[Photograph], downscale: int = 1, need_photos: bool = True) -> list[list[Lens]]:
    """Make the lenses of each photograph, equal ones once; `need_photos`: check sizes of downscaled copies."""
    sizes = in_threads(lambda each: image_size(each.file) if each.downscaled and need_photos else None, photographs)
    made: dict[tuple[Any, ...], list[Lens]] = {}
    lenses, messages = [], []
    for photograph, size in zip(photographs, sizes, strict=True):
        camera = photograph.camera
        small = scaled_size(camera.size, 1 / downscale)
        if size is not None and max(abs(size[0] - small[0]), abs(size[1] - small[1])) > 1:
            camera_is = f"but 1/{downscale} of its camera's is {small[0]} x {small[1]}"
            advice = f"Make {photograph.file.parent} again, or leave --downscale-factor out."
            fail(f"the image {photograph.file} has {size[0]} x {size[1]} pixels, {camera_is}. {advice}")
        used = size or small
        key = (camera, used, photograph.downscaled)
        if key not in made:
            stored = used if photograph.downscaled else camera.size
            made[key] = lenses_of(camera.rescaled(*used), stored, photograph.label)
            if made[key][0].face or camera.colmap.is_perspective_fisheye():
                sizes_of = [f"{x.face} {x.pinhole.width} x {x.pinhole.height}".strip() for x in made[key]]
                become = f"its photographs become pinhole pictures ({', '.join(sizes_of)})"
                messages.append(f"{photograph.label} is {camera.model}: {become}")
        lenses.append(made[key])
    if messages:
        shown = listed(messages)
        say(f"{shown[0].upper()}{shown[1:]}.")
    return lenses


def _faces(colmap: ColmapCamera, stored: tuple[int, int]) -> list[Lens]:
    """Make lenses of the cube faces that a camera covers, with its focal length."""
    camera = colmap.colmap
    around = colmap.width / (2.0 * math.pi)
    fx, fy = (around, around) if camera.is_spherical() else (camera.focal_length_x, camera.focal_length_y)
    t = np.linspace(-1.0, 1.0, NODES)  # in focal lengths
    rays, lenses = _through(t, t[:, None]), []
    for face in FACES:
        seen = covered(colmap, face, rays)
        if seen.mean() < LEAST_SHARE:
            continue
        (up, down), (first, last) = (np.flatnonzero(seen.any(axis))[[0, -1]] for axis in (1, 0))
        whole = bool(seen[up : down + 1, first : last + 1].all())
        left, right, top, bottom = t[[first, last, up, down]].tolist()
        w, h = max(1, round((right - left) * fx)), max(1, round((bottom - top) * fy))
        u, v = w / (right - left), h / (bottom - top)
        lenses.append(Lens(colmap, stored, Pinhole(u, v, -left * u, -top * v, w, h), face, whole))
    return lenses


def _window(camera: ColmapCamera) -> tuple[float, float, float, float]:
    """Measure how far the pinhole picture extends to the left, right, top and bottom of the axis, in focal lengths:
    maximize each side alone, then scale all until the photograph covers the corners, too."""
    most = math.tan(math.radians(0.5 * MAX_VIEW_ANGLE))
    reach = np.zeros(4)

    def seen(x: npt.ArrayLike, y: npt.ArrayLike) -> bool:
        return bool(covered(camera, "front", _through(x, y)).all())

    for side, (x, y) in enumerate(((-most, 0.0), (most, 0.0), (0.0, -most), (0.0, most))):
        reach[side] = most * _largest(lambda s, x=x, y=y: seen(s * x, s * y))

    def border(scale: float) -> bool:
        left, right, top, bottom = scale * reach
        t = np.linspace(0.0, 1.0, EDGE_SAMPLES)
        x, y = -left + t * (left + right), -top + t * (top + bottom)
        return seen(x, np.array([[-top], [bottom]])) and seen(np.array([[-left], [right]]), y)

    left, right, top, bottom = reach * _largest(border)
    return left, right, top, bottom


def _largest(fits: Callable[[float], bool]) -> float:
    """Bisect for the largest number in [0, 1] that fits, to 24 bits."""
    parts = 1 << 24
    return bisect_left(range(1, parts + 1), True, key=lambda part: not fits(part / parts)) / parts


@lru_cache(maxsize=CACHED_MAPS)
def _maps(lens: Lens) -> tuple[npt.NDArray[Any], npt.NDArray[Any]]:
    """Compute fixed-point maps (int16, uint16) for cv2.remap."""
    to = lens.pinhole
    x, y = (np.arange(0, size + NODE_STEP, NODE_STEP) + 0.5 for size in (to.width, to.height))
    rays = _through((x - to.cx) / to.fx, (y[:, None] - to.cy) / to.fy)
    nodes = lens.camera.pixels_of(rays.reshape(-1, 3)) - 0.5
    nodes = nodes.reshape(len(y), len(x), 2).astype(np.float32)
    scale = np.array([[1.0 / NODE_STEP, 0.0, 0.0], [0.0, 1.0 / NODE_STEP, 0.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    whole = cv2.warpAffine(nodes, scale, (to.width, to.height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return cv2.convertMaps(whole, NO_MAP, cv2.CV_16SC2)


def covered(camera: ColmapCamera, face: str, rays: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Test which rays [..., 3] of a face the photograph shows without folds."""
    if camera.colmap.is_spherical():
        return np.ones(rays.shape[:-1], bool)
    directions = (rays @ FACES[face]).reshape(-1, 3)
    near = directions[:, 2] > np.linalg.norm(directions, axis=1) * math.cos(_field(camera))
    pixels = np.full((len(directions), 2), np.nan)
    pixels[near] = camera.pixels_of(directions[near])
    with np.errstate(invalid="ignore"):
        return ((pixels >= 0.0) & (pixels <= camera.size)).all(1).reshape(rays.shape[:-1])


@lru_cache(maxsize=64)
def _field(camera: ColmapCamera) -> float:
    """Find the largest angle to the axis up to which pixels move outwards, radians."""
    lens = camera.colmap
    angles = np.linspace(0.0, MAX_ANGLE, ANGLES + 1)[1:]
    azimuths = np.linspace(0.0, 2.0 * np.pi, AZIMUTHS, endpoint=False)
    angle, azimuth = np.meshgrid(angles, azimuths, indexing="ij")
    rays = np.stack([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)], -1)
    pixels = camera.pixels_of(rays.reshape(-1, 3)).reshape(*rays.shape[:2], 2)
    away = np.linalg.norm(pixels - (lens.principal_point_x, lens.principal_point_y), axis=-1)
    outwards = (np.diff(away, axis=0, prepend=0.0) > 0.0).all(1)
    return float(MAX_ANGLE if outwards.all() else angles[max(0, int(outwards.argmin()) - 1)])


def colmap_distortion(kind: str, values: Sequence[float], label: str) -> tuple[str, tuple[float, ...]]:
    """Convert nerfstudio's camera type (`transforms.CAMERA_TYPES`) and distortion_params (k1, k2, k3, k4, p1, p2;
    twelve of FISHEYE624) to COLMAP's model and its parameters after fx, fy, cx, cy; none of SPHERICAL_MODEL. Raises
    CaptureError: COLMAP has no such camera, or `values` are of another number."""
    if kind == "EQUIRECTANGULAR":
        return SPHERICAL_MODEL, ()
    counts = {"PERSPECTIVE": (6,), "FISHEYE": (4, 6), "FISHEYE624": (12,)}.get(kind)
    if counts is None:
        kinds = "neither a perspective, a fisheye nor an equirectangular camera"
        fail(f"the camera {label} cannot be used: it is {kinds}, but {kind}. Correct the capture.")
    if len(values) not in counts:
        needs = f"{kind.lower()} cameras need {counts[0]} (k1, k2, k3, k4, then p1, p2)"
        fail(f"the camera {label} has {len(values)} distortion_params; {needs}. Correct the capture.")
    if kind == "FISHEYE624":
        return "RAD_TAN_THIN_PRISM_FISHEYE", tuple(values)
    if kind == "FISHEYE":
        return "OPENCV_FISHEYE", tuple(values[:4])
    k1, k2, k3, k4, p1, p2 = values
    if k4 != 0.0:
        what = f"the camera {label} cannot be used: its k4 is {k4:g}, which perspective cameras lack"
        fail(f"{what}. For a fisheye write camera_model OPENCV_FISHEYE; else undistort first.")
    if k3 != 0.0:
        return "FULL_OPENCV", (k1, k2, p1, p2, k3, 0.0, 0.0, 0.0)
    return ("OPENCV", (k1, k2, p1, p2)) if any((k1, k2, p1, p2)) else ("PINHOLE", ())
