"""Rendering of baked scenes: forward only, with texels instead of the field."""

from collections.abc import Sequence

import torch
from torch import Tensor

from . import baked_cpu, webgpu
from .backend import cuda_backend
from .baked_renderer import BakedRenderer, Workspace
from .baked_scene import IMAGES, BakedSceneLike, DrawCache, check_images, common_size, packed
from .project import CameraLike

__all__ = ["IMAGES", "BakedSceneLike", "DrawCache", "common_size", "draw", "packed"]


@torch.no_grad()
def draw(
    scene: BakedSceneLike,
    cameras: Sequence[CameraLike],
    background: Tensor | None,
    images: Sequence[str],
    photo_pixel: float = 1.0,
) -> dict[str, Tensor]:
    """Draw views of one size: in one batch on a CUDA device, one by one on the CPU and with WebGPU.

    Args:
        scene: on the rendering device; on any device for WebGPU.
        cameras: at least one.
        background: [3] colour behind the scene; None: black.
        images: names of `IMAGES` to draw.
        photo_pixel: side of a photograph's pixel in pixels of the views (csrc/core/resize.h).

    Returns:
        name -> [views, height, width, channels].

    Raises:
        ValueError: the cameras differ in size or have skew; an image is unknown or not available on this device; on the
            CPU, the atlas was not decoded from BC7 blocks; on a CUDA device, views times surfels exceed 2^24.
        RuntimeError: not enough memory on the device, or WebGPU is requested but not available.
    """
    device, size = scene.tiles.device, common_size(cameras)
    on_cuda = cuda_backend(device) and not scene.through_webgpu
    check_images(images, on_cuda)
    if not on_cuda:
        by = webgpu if scene.through_webgpu else baked_cpu
        return by.draw(scene, cameras, background, images, photo_pixel)
    with scene.cache.workspaces(lambda: Workspace(device)).borrow() as workspace:
        renderer = BakedRenderer(
            scene, *size, len(cameras), images, background, photo_pixel=photo_pixel, workspace=workspace
        )
        return renderer.draw(cameras)  # waits: the next frame may use the memory on another stream
