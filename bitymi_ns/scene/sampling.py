"""Supersampling and texture filtering of views that show the scene smaller or larger than the photographs."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from bitymi_ns.ops.constants import SUPPORT
from .camera import Camera

AS_TRAINED = (0.75, 1.5)
"""Scales between which views are rendered as in training: photographs, too, show the scene from near and far."""
SMALLEST, LARGEST = 0.5, 2.0
"""Scales beyond which the pixel footprint follows the view's scale."""
ONE_SAMPLE, TWO_SAMPLES = 0.6, 1 / 3
"""Smallest scales with one sample per pixel, and with two along each axis."""
SAMPLE = 0.58
"""Minimum number of samples across a photograph's pixel at smaller scales, within the limits below: coarser ones blur
edges that the alpha texels of several surfels share, as the mean transmittance of a stack is not the product of the
means."""
MOST_SAMPLES, FEW_PIXELS = 6, 1 << 21  # maximum per pixel along each axis; more up to this number of samples in all
MOST_PIXELS = 1 << 24  # maximum number of samples of a view
FARTHEST = (1.0 / 64, 64.0)  # range of scales
RIM = 3  # pixels around discs that the low pass and widened kernels may reach

Part = tuple[int, int, int, int]  # part of an image: left, top, right, bottom in pixels, the last two exclusive


@dataclass(frozen=True)
class Sampling:
    """Samples per pixel of a view.

    Attributes:
        samples: per pixel along each axis.
        photo_pixel: side of a photograph's pixel in samples (csrc/core/resize.h).
        part: rendered part of the view: surfels reach no other pixels; None = the whole view.
    """

    samples: int = 1
    photo_pixel: float = 1.0
    part: Part | None = None


def size_of(photographed: Tensor, camera: Camera) -> float:
    """Measure the scale of a view relative to the photographs, 0.5 = half their size: the median over the points of
    `photographed` (`BakedScene`) inside the image; 1 without any."""
    # NumPy: for a few thousand points per frame, torch's overhead would dominate
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


def part_of(surfels: Mapping[str, Tensor], cameras: Sequence[Camera], near: float) -> Part:
    """Bound the part of views of one size, at least a pixel, in which surfels can be seen, by spheres around their
    discs. `surfels`: means [N, 3] and log_scales [N, 2], on the cameras' device. `near`: nearest depth of a centre."""
    reach = SUPPORT * surfels["log_scales"].amax(1).exp()
    bounds = []
    for camera in cameras:
        local = camera.local(surfels["means"])
        shown = local.isfinite().all(1) & (local[:, 2] > near)
        (x, y, z), radius = local[shown].unbind(1), reach[shown]
        for axis, slope in enumerate((x / z, y / z)):
            half = torch.where(z > radius, radius * (1 + slope.abs()) / (z - radius), math.inf)
            ends = torch.stack([slope - half, -slope - half]).amin(1) if len(z) else slope.new_zeros(2)
            bounds.append(ends * camera.K[axis, axis] + torch.stack([camera.K[axis, 2], -camera.K[axis, 2]]))
    low, high = torch.stack(bounds).view(-1, 2, 2).amin(0).unbind(1)
    size = cameras[0].width, cameras[0].height
    first = [int(min(max(begin - RIM, 0), side - 1)) for begin, side in zip(low.tolist(), size, strict=True)]
    last = [
        math.ceil(max(min(RIM - end, side), begin + 1))
        for end, side, begin in zip(high.tolist(), size, first, strict=True)
    ]
    return first[0], first[1], last[0], last[1]


def sampling_of(size: float, pixels: int) -> Sampling:
    """Choose the sampling of a view of some scale and number of pixels."""
    low, high = AS_TRAINED
    if low <= size <= high:
        return Sampling()
    wanted = 1 if size >= ONE_SAMPLE else 2 if size >= TWO_SAMPLES else max(3, math.ceil(SAMPLE / size))
    few, most = (math.isqrt(limit // max(pixels, 1)) for limit in (FEW_PIXELS, MOST_PIXELS))
    samples = max(1, min(wanted, max(MOST_SAMPLES, few), most))
    shown = samples * size
    if samples > 1:
        return Sampling(samples, shown)
    if SMALLEST < size < low:
        shown = SMALLEST ** (math.log(low / size) / math.log(low / SMALLEST))
    elif high < size < LARGEST:
        shown = LARGEST ** (math.log(size / high) / math.log(LARGEST / high))
    return Sampling(samples, shown)


def averaged(images: dict[str, Tensor], samples: int) -> dict[str, Tensor]:
    """Downsample images [views, samples * height, samples * width, channels] by name to [views, height, width,
    channels]: means, but sums of integers (counts)."""
    out = {}
    for name, image in images.items():
        total = image
        for axis in (1, 2):  # one at a time: faster than one strided reduction over both
            total = total.unflatten(axis, (-1, samples)).sum(axis + 1, dtype=image.dtype)
        out[name] = total / samples**2 if image.is_floating_point() else total
    return out


def padded(image: Tensor, part: Part, size: tuple[int, int], around: Tensor | None = None) -> Tensor:
    """Pad images [views, rows, columns, channels] of a part of views to whole views of `size`, height and width, with
    `around` [channels]; None: 0."""
    left, top, right, bottom = part
    whole = image.new_zeros(len(image), *size, image.shape[-1])
    if around is not None:
        whole += around.to(image)
    whole[:, top:bottom, left:right] = image
    return whole
