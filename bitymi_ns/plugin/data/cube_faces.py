"""Wide cameras as pinhole views: the faces of a cube around the camera, as far as a photograph covers them."""

import math
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from bitymi_ns.capture.camera import ColmapCamera

FACES: dict[str, tuple[tuple[float, float, float], ...]] = {
    "front": ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    "right": ((0.0, 0.0, -1.0), (0.0, 1.0, 0.0), (1.0, 0.0, 0.0)),
    "back": ((-1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, -1.0)),
    "left": ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0), (-1.0, 0.0, 0.0)),
    "up": ((1.0, 0.0, 0.0), (0.0, 0.0, 1.0), (0.0, -1.0, 0.0)),
    "down": ((1.0, 0.0, 0.0), (0.0, 0.0, -1.0), (0.0, 1.0, 0.0)),
}
"""Right, down and forward of each face in the axes of the whole camera (OpenCV); a face is 90 degrees wide and high."""
MAX_ANGLE = math.radians(89.9)
"""Largest angle to the axis; COLMAP's fisheye models end before 90 degrees."""
NODES = 361
"""Rays along a side of a face at which coverage is tested."""
LEAST_SHARE = 0.05
"""A face of which less is covered is left out: it would be a view as any other, for a strip at the edge."""
ANGLES, AZIMUTHS = 360, 64
"""Rays for testing where the distortion folds the picture."""
SAMPLES = 2
"""Samples of the photograph along and across a pixel of a face: where a photograph is denser than the face, as
equirectangular ones at the poles, one sample would alias."""
BAND = 256
"""Rows of a face that are resampled together."""
PAD = 2
"""Columns of the other edge that continue a picture of all directions."""


@lru_cache(maxsize=64)
def windows(camera: ColmapCamera) -> dict[str, tuple[float, float, float, float, bool]]:
    """Find the part of each face of the cube that a camera covers, see `covered`: left, right, top and bottom in focal
    lengths, within -1 to 1, and whether the photograph covers all of it."""
    found = {}
    t = np.linspace(-1.0, 1.0, NODES)
    rays = np.stack(np.broadcast_arrays(t[None, :], t[:, None], 1.0), -1)
    for face in FACES:
        seen = covered(camera, face, rays)
        if seen.mean() < LEAST_SHARE:
            continue
        (top, bottom), (left, right) = (np.flatnonzero(seen.any(axis))[[0, -1]] for axis in (1, 0))
        whole = bool(seen[top : bottom + 1, left : right + 1].all())
        found[face] = (t[left], t[right], t[top], t[bottom], whole)
    return found


def covered(camera: ColmapCamera, face: str, rays: npt.NDArray[np.float64]) -> npt.NDArray[np.bool_]:
    """Test which rays [..., 3] of a face a photograph shows, where the model does not fold it."""
    if camera.colmap.is_spherical():
        return np.ones(rays.shape[:-1], bool)
    directions = (rays @ FACES[face]).reshape(-1, 3)
    near = directions[:, 2] > np.linalg.norm(directions, axis=1) * math.cos(_field(camera))
    pixels = np.full((len(directions), 2), np.nan)
    pixels[near] = camera.colmap.img_from_cam(directions[near])
    with np.errstate(invalid="ignore"):
        return ((pixels >= 0.0) & (pixels <= camera.size)).all(1).reshape(rays.shape[:-1])


@lru_cache(maxsize=64)
def _field(camera: ColmapCamera) -> float:
    """Largest angle to the axis up to which pixels move outwards with it, radians."""
    lens = camera.colmap
    angles = np.linspace(0.0, MAX_ANGLE, ANGLES + 1)[1:]
    azimuths = np.linspace(0.0, 2.0 * np.pi, AZIMUTHS, endpoint=False)
    angle, azimuth = np.meshgrid(angles, azimuths, indexing="ij")
    rays = np.stack([np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)], -1)
    pixels = lens.img_from_cam(rays.reshape(-1, 3)).reshape(*rays.shape[:2], 2)
    away = np.linalg.norm(pixels - (lens.principal_point_x, lens.principal_point_y), axis=-1)
    outwards = (np.diff(away, axis=0, prepend=0.0) > 0.0).all(1)
    return float(MAX_ANGLE if outwards.all() else angles[max(0, int(outwards.argmin()) - 1)])


def resample(
    pixels: npt.NDArray[np.uint8],
    camera: ColmapCamera,
    face: str,
    pinhole: tuple[float, float, float, float, int, int],
    nearest: bool = False,
) -> npt.NDArray[np.uint8]:
    """Resample a photograph [H, W] or [H, W, C], of the size that its wide camera is for, to a face of the cube.

    Args:
        pinhole: fx, fy, cx, cy, width and height of the result in pixels.
        nearest: take the nearest pixel, for masks.
    """
    lens = camera.colmap
    fx, fy, cx, cy, width, height = pinhole
    samples = 1 if nearest else SAMPLES
    pad = PAD if lens.is_spherical() else 0
    if pad:
        pixels = cv2.copyMakeBorder(pixels, 0, 0, pad, pad, cv2.BORDER_WRAP)
    x = ((np.arange(width * samples) + 0.5) / samples - cx) / fx
    bands = []
    for start in range(0, height, BAND):
        rows = min(BAND, height - start)
        y = (start + (np.arange(rows * samples) + 0.5) / samples - cy) / fy
        rays = np.stack(np.broadcast_arrays(x[None, :], y[:, None], 1.0), -1).reshape(-1, 3) @ FACES[face]
        at = lens.img_from_cam(rays).astype(np.float32).reshape(len(y), len(x), 2) + np.float32([pad - 0.5, -0.5])
        how = cv2.INTER_NEAREST if nearest else cv2.INTER_CUBIC  # linear blurs: 1 dB on a ray-traced room
        band = cv2.remap(pixels, at, None, how, borderMode=cv2.BORDER_REPLICATE)
        bands.append(band if samples == 1 else cv2.resize(band, (width, rows), interpolation=cv2.INTER_AREA))
    return np.concatenate(bands)
