"""Drawing a baked scene: forward only, texels in place of the field."""

from collections.abc import Sequence

import torch
from torch import Tensor

from . import baked_cpu, baked_cuda, webgpu
from .backend import cuda_backend
from .baked_scene import IMAGES, BakedScene, DrawCache, common_size, packed
from .project import Camera

__all__ = ["IMAGES", "BakedScene", "DrawCache", "common_size", "draw", "packed"]


@torch.no_grad()
def draw(
    scene: BakedScene,
    cameras: Sequence[Camera],
    background: Tensor | None,
    images: Sequence[str],
    photo_pixel: float = 1.0,
) -> dict[str, Tensor]:
    """Draw views of one size. On a CUDA device all in one go; on the CPU and through WebGPU one after the other.

    Args:
        scene: on the device that draws; anywhere, if it asks for WebGPU.
        cameras: at least one.
        background: [3] colour behind the scene; None = black.
        images: what to draw, names of `IMAGES`.
        photo_pixel: side of a photograph's pixel in pixels of the views (csrc/core/resize.h).

    Returns:
        name -> [views, height, width, channels].

    Raises:
        ValueError: the cameras differ in size or have skew; there is no such image, or this device cannot draw it; on
            the CPU, the atlas was not decoded from BC7 blocks; on a CUDA device, views times surfels is above 2^24.
        RuntimeError: the device has too little memory; or it is WebGPU that is asked for, and it is not there.
    """
    if scene.through_webgpu:
        return webgpu.draw(scene, cameras, background, images, photo_pixel)
    by = baked_cuda if cuda_backend(scene.tiles.device) else baked_cpu
    return by.draw(scene, cameras, background, images, photo_pixel)
