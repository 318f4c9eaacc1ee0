"""Lenses of photographs: pictures of a pinhole camera out of what COLMAP's camera models describe."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import numpy.typing as npt
import pycolmap
from PIL import Image

from bitymi_ns.capture.masks import in_proportion
from bitymi_ns.capture.panorama import PANORAMAS
from bitymi_ns.plugin.console import fail, warn
from bitymi_ns.plugin.data.cameras import LITTLE_LEFT, NOTHING_LEFT
from bitymi_ns.plugin.data.images import wrong_size

WIDEST = 110.0
"""Degrees that a pinhole picture of a photograph spans at most, across and down. Beyond, a picture grows fast and shows
little: each further degree takes more pixels, out of ever fewer of the photograph."""
STEP = 4
"""Pixels between the points at which a lens is evaluated; between them its distortion is linear to far less than a
pixel."""
ALONG = 32
"""Points along a ray on which a lens must not fold the picture."""
AROUND = 64
"""Rays to each edge of a picture on which that is tested."""
MAPS = 4
"""Lenses whose maps are kept; one of 12 million pixels takes 72 MB."""


@dataclass(frozen=True)
class Pinhole:
    """A pinhole camera, in pixels; the upper left corner of a picture is at (0, 0)."""

    fx: float
    fy: float
    cx: float
    cy: float
    width: int
    height: int

    @property
    def view(self) -> tuple[float, float]:
        """Degrees that its picture spans across and down."""
        across = math.atan(self.cx / self.fx) + math.atan((self.width - self.cx) / self.fx)
        down = math.atan(self.cy / self.fy) + math.atan((self.height - self.cy) / self.fy)
        return math.degrees(across), math.degrees(down)


@dataclass(frozen=True)
class Lens:
    """How a photograph becomes the picture of a pinhole camera.

    Attributes:
        model: camera model of COLMAP.
        params: its parameters, for pictures of `size`.
        size: width and height to which a photograph is reduced first.
        stored: width and height of the photograph in its file.
        pinhole: the camera of the result.
    """

    model: str
    params: tuple[float, ...]
    size: tuple[int, int]
    stored: tuple[int, int]
    pinhole: Pinhole

    @property
    def distorts(self) -> bool:
        """Whether pixels move."""
        return _distorts(_camera(self))

    def picture(self, image: Image.Image) -> Image.Image:
        """The pinhole picture of a photograph, of any 8-bit mode; it may have been decoded to a smaller size than that
        of its file, but not below `size`."""
        if image.size != self.size:
            image = image.resize(self.size, Image.Resampling.BOX)
        if not self.distorts:
            return image
        pixels = cv2.remap(np.asarray(image), *_maps(self), cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return Image.fromarray(pixels, image.mode)

    def mask(self, mask: Image.Image, path: Path) -> Image.Image:
        """The same for a mask: pixels count where the nearest of the photograph does. It may have another size, as that
        of a photograph that was reduced, but not other proportions."""
        if not in_proportion(mask.size, self.stored):
            fail(wrong_size(path, mask.size, self.stored))
        pixels = np.asarray(mask.resize(self.size, Image.Resampling.NEAREST)).astype(np.uint8)
        if self.distorts:
            pixels = cv2.remap(pixels, *_maps(self), cv2.INTER_NEAREST, borderMode=cv2.BORDER_REPLICATE)
        return Image.fromarray(pixels.astype(bool))

    def reduced(self, factor: float) -> Lens:
        """The same lens for pictures that are smaller by a factor."""
        width, height = (max(1, round(side * factor)) for side in self.size)
        return lens(
            self.model, rescaled(self.model, self.params, self.size, (width, height)), width, height, self.stored, ""
        )[0]


def lens(
    model: str, params: tuple[float, ...], width: int, height: int, stored: tuple[int, int], whose: str
) -> tuple[Lens, list[str]]:
    """The lens of a camera.

    Args:
        model: camera model of COLMAP.
        params: its parameters, for pictures of `width` x `height`.
        stored: width and height of the photographs in their files, which may be larger.
        whose: the camera or its photographs, for messages.

    Returns:
        the lens, and sentences on what is lost with it.

    Raises:
        InputError: the camera cannot be used; says why.
    """
    camera = pycolmap.Camera(model=model, width=width, height=height, params=list(params))
    if camera.is_spherical():
        fail(f"{whose} is {model}. {PANORAMAS}")
    focal = (camera.focal_length_x, camera.focal_length_y)
    if not np.isfinite(params).all() or min(focal) <= 0.0 or min(width, height) < 1:
        fail(
            f"{whose} ({model}, {width} x {height}, {camera.params_to_string()}) cannot be used: its size and focal "
            "lengths have to be positive and all parameters finite. Correct it, or write the model anew from COLMAP."
        )
    center = (camera.principal_point_x, camera.principal_point_y)
    if not _distorts(camera):
        pinhole = Pinhole(*focal, *center, width, height)
        return Lens(model, params, (width, height), stored, pinhole), []
    left, right, top, bottom = _window(camera)
    w, h = int((left + right) * focal[0]), int((top + bottom) * focal[1])
    share = w * h / (width * height)
    if share < NOTHING_LEFT or min(w, h) < 1:
        fail(
            f"the lens distortion of {whose} is absurd: with {model} {camera.params_to_string()} undistorting would "
            f"leave {100.0 * share:.2g} % of the picture. Correct the numbers, or calibrate again with a simpler model "
            "(SIMPLE_RADIAL)."
        )
    if share < LITTLE_LEFT:
        warn(f"Undistorting leaves only {100.0 * share:.2g} % of {whose}. The lens distortion may be wrong.")
    pinhole = Pinhole(*focal, left * focal[0], top * focal[1], w, h)
    told = []
    if camera.is_perspective_fisheye() or max(pinhole.view) > WIDEST - 0.5:
        across, down = pinhole.view
        told.append(
            f"{whose} is {model}: its photographs are used as pinhole pictures of {across:.0f} x {down:.0f} degrees "
            f"({w} x {h} pixels); what they show beyond is not used."
        )
    return Lens(model, params, (width, height), stored, pinhole), told


def rescaled(model: str, params: Sequence[float], size: tuple[int, int], new: tuple[int, int]) -> tuple[float, ...]:
    """The parameters of a camera for pictures of another size.

    Args:
        model: camera model of COLMAP.
        params: its parameters, for pictures of `size`, width and height.
        new: width and height.
    """
    if new == size:
        return tuple(params)
    camera = pycolmap.Camera(model=model, width=size[0], height=size[1], params=list(params))
    camera.rescale(*new)
    return tuple(camera.params)


def _camera(lens: Lens) -> pycolmap.Camera:
    return pycolmap.Camera(model=lens.model, width=lens.size[0], height=lens.size[1], params=list(lens.params))


def _distorts(camera: pycolmap.Camera) -> bool:
    # pycolmap's test looks at the coefficients alone, of which fisheye models need none
    return camera.is_perspective_fisheye() or not camera.is_undistorted()


def _window(camera: pycolmap.Camera) -> tuple[float, float, float, float]:
    """How far a pinhole picture can reach to the left, right, top and bottom of the axis, in focal lengths.

    It shows nothing that the photograph does not: neither beyond its edges, nor where the model folds the picture. Each
    side reaches as far as it can on its own, then all are scaled until the corners fit, too.
    """
    most = math.tan(math.radians(0.5 * WIDEST))
    reach = np.zeros(4)
    for side, direction in enumerate(((-1.0, 0.0), (1.0, 0.0), (0.0, -1.0), (0.0, 1.0))):
        reach[side] = most * _largest(lambda s, d=direction: _is_seen(camera, s * most * np.array([d])))

    def window(scale: float) -> npt.NDArray[np.float64]:
        left, right, top, bottom = scale * reach
        t = np.linspace(0.0, 1.0, AROUND)
        x, y = -left + t * (left + right), -top + t * (top + bottom)
        edges = [(x, np.full(AROUND, -top)), (x, np.full(AROUND, bottom))]
        edges += [(np.full(AROUND, -left), y), (np.full(AROUND, right), y)]
        return np.concatenate([np.stack(edge, -1) for edge in edges])

    left, right, top, bottom = reach * _largest(lambda s: _is_seen(camera, window(s)))
    return left, right, top, bottom


def _largest(fits: Callable[[float], bool]) -> float:
    """The largest number of [0, 1] for which a condition holds that holds for all smaller ones."""
    if fits(1.0):
        return 1.0
    low, high = 0.0, 1.0
    for _ in range(24):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if fits(middle) else (low, middle)
    return low


def _is_seen(camera: pycolmap.Camera, rays: npt.NDArray[np.float64]) -> bool:
    """Whether the photograph shows all rays (x, y, 1) [N, 2], and on the way to each moves outwards all the time."""
    t = np.linspace(0.0, 1.0, ALONG + 1)[1:]
    points = (t[:, None, None] * rays).reshape(-1, 2)
    pixels = camera.img_from_cam(np.concatenate([points, np.ones((len(points), 1))], 1)).reshape(ALONG, -1, 2)
    if not np.isfinite(pixels).all():
        return False
    inside = (pixels >= 0.0).all() and (pixels <= (camera.width, camera.height)).all()
    away = np.linalg.norm(pixels - (camera.principal_point_x, camera.principal_point_y), axis=-1)
    return bool(inside and (np.diff(away, axis=0) > 0.0).all())


@lru_cache(maxsize=MAPS)
def _maps(lens: Lens) -> tuple[npt.NDArray[np.int16], npt.NDArray[np.uint16]]:
    """For each pixel of the result where it lies in the photograph, as cv2.remap takes it."""
    to = lens.pinhole
    x, y = (np.arange(0, size + STEP, STEP) + 0.5 for size in (to.width, to.height))
    rays = np.stack(np.meshgrid((x - to.cx) / to.fx, (y - to.cy) / to.fy), -1).reshape(-1, 2)
    nodes = _camera(lens).img_from_cam(np.concatenate([rays, np.ones((len(rays), 1))], 1)) - 0.5
    nodes = nodes.reshape(len(y), len(x), 2).astype(np.float32)
    scale = np.array([[1.0 / STEP, 0.0, 0.0], [0.0, 1.0 / STEP, 0.0]])
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    whole = cv2.warpAffine(nodes, scale, (to.width, to.height), flags=flags, borderMode=cv2.BORDER_REPLICATE)
    return cv2.convertMaps(whole, None, cv2.CV_16SC2)
