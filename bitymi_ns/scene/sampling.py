"""Sampling of views of another size than the photographs: resolution of the photographs, samples per pixel."""

import math
from dataclasses import dataclass

import numpy as np
from torch import Tensor

from .camera import Camera

AS_TRAINED = (0.75, 1.5)
"""Views between these sizes are drawn as in training. The sizes of the photographs differ, too: they see a scene from
near and from far."""
SMALLEST, LARGEST = 0.5, 2.0
"""Views beyond these sizes are drawn for what they are; in between it changes over, so that nothing jumps."""
ONE_SAMPLE, TWO_SAMPLES = 0.6, 1 / 3
"""Views from these sizes on have one sample per pixel, and two along each axis."""
SAMPLE = 0.58
"""Least samples across a pixel of a photograph in smaller views, as far as MOST_SAMPLES and MOST_PIXELS allow.
Wider samples lose the edges that alpha texels of several surfels share: the mean transmittance of a stack is not the
product of its means."""
MOST_SAMPLES = 6  # samples per pixel, along each axis
MOST_PIXELS = 1 << 24  # samples of a view: beyond, it has fewer samples per pixel
FARTHEST = (1.0 / 64, 64.0)


@dataclass(frozen=True)
class Sampling:
    """Samples per pixel of a view.

    Attributes:
        samples: per pixel, along each axis.
        photo_pixel: side of a photograph's pixel in samples (csrc/core/resize.h).
    """

    samples: int = 1
    photo_pixel: float = 1.0


def size_of(photographed: Tensor, camera: Camera) -> float:
    """Scale at which a view shows the photographs: 1 = as large as the photographs, 0.5 = at half their size.

    Args:
        photographed: [P, 4] points of the scene, and the pixels per unit of length with which they were photographed.

    Returns:
        the median over the points in the picture; 1 where there is none.
    """
    # NumPy: of a few thousand points, torch would take longer to start than to work, in every frame
    viewmat, K, points = (t.detach().cpu().double().numpy() for t in (camera.viewmat, camera.K, photographed))
    x, y, z = (points[:, :3] @ viewmat[:3, :3].T + viewmat[:3, 3]).T
    depth = np.maximum(z, 1e-12)
    column, row = K[0, 0] * x / depth + K[0, 2], K[1, 1] * y / depth + K[1, 2]
    inside = (z > 0) & (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    sizes = (math.sqrt(K[0, 0] * K[1, 1]) / (depth * points[:, 3]))[inside]
    if not len(sizes):
        return 1.0
    middle = (len(sizes) - 1) // 2
    return float(np.clip(np.partition(sizes, middle)[middle], *FARTHEST))


def sampling_of(size: float, pixels: int) -> Sampling:
    """Choose the samples per pixel of a view."""
    low, high = AS_TRAINED
    if low <= size <= high:
        return Sampling()
    wanted = 1 if size >= ONE_SAMPLE else 2 if size >= TWO_SAMPLES else max(3, math.ceil(SAMPLE / size))
    samples = max(1, min(wanted, MOST_SAMPLES, math.isqrt(MOST_PIXELS // max(pixels, 1))))
    shown = samples * size
    if samples > 1:
        return Sampling(samples, shown)
    if SMALLEST < size < low:
        shown = SMALLEST ** (math.log(low / size) / math.log(low / SMALLEST))
    elif high < size < LARGEST:
        shown = LARGEST ** (math.log(size / high) / math.log(LARGEST / high))
    return Sampling(samples, shown)


def averaged(images: dict[str, Tensor], samples: int) -> dict[str, Tensor]:
    """Images of views from images of their samples.

    Args:
        images: name -> [views, samples * height, samples * width, channels].
        samples: per pixel, along each axis.

    Returns:
        name -> [views, height, width, channels]: means, of integers (counts) sums.
    """
    if samples == 1:
        return images
    out = {}
    for name, image in images.items():
        total = image
        for axis in (1, 2):  # one after the other: torch would walk both in strides
            total = total.unflatten(axis, (-1, samples)).sum(axis + 1, dtype=image.dtype)
        out[name] = total / samples**2 if image.is_floating_point() else total
    return out
