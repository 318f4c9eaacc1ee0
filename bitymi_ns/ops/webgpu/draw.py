"""Drawing a baked scene through WebGPU, as the kernels draw it."""

from collections.abc import Sequence

import torch
from torch import Tensor

from ..baked_scene import BakedScene, check_images, common_size
from ..project import Camera
from .on_device import SceneOnDevice

LAYERS = 16  # batches in which surfels are drawn: docs/viewer.md has what fewer cost in the picture
_FROM = {
    "rgb": ("color", slice(0, 3)),
    "alpha": ("color", slice(3, 4)),
    "depth": ("depth", slice(0, 1)),
    "beta": ("depth", slice(1, 2)),
    "normal": ("normal", slice(0, 3)),
    "overdraw": ("overdraw", slice(0, 1)),
}


def draw(
    scene: BakedScene,
    cameras: Sequence[Camera],
    background: Tensor | None,
    images: Sequence[str],
    photo_pixel: float = 1.0,
    layers: int = LAYERS,
) -> dict[str, Tensor]:
    """As `baked.draw`, one view after the other; the images lie on the CPU.

    Raises:
        WebGpuUnavailable: the package wgpu or a graphics device is missing.
    """
    check_images(images)
    if "packed" in images:
        raise ValueError("the image 'packed' is drawn on a CUDA device only: draw rgb and alpha")
    common_size(cameras)
    arrays = (scene.tiles, scene.atlas, scene.blocks, scene.extent, scene.mean_residual, scene.mean_alpha)
    sources = (*scene.surfels.values(), *arrays)
    scales = f"{scene.offset} {scene.scale} {scene.alpha_scale}"
    numbers = f"webgpu {scene.near} {scene.weight_bound} {scales} {scene.prefilter}"
    there = scene.cache.atlas(lambda: SceneOnDevice(scene), *sources, numbers)
    drawn: dict[str, list[Tensor]] = {name: [] for name in images}
    for camera in cameras:
        sums = {
            show: torch.from_numpy(there.draw(camera, show, layers, photo_pixel))
            for show in {_FROM[name][0] for name in images}
        }
        for name, views in drawn.items():
            show, channels = _FROM[name]
            found = sums[show][..., channels]
            if name == "alpha":
                found = 1 - found
            elif name == "overdraw":
                found = found.round().int()
            elif name == "rgb" and background is not None:
                found = found + sums[show][..., 3:4] * background.detach().float().cpu()
            views.append(found.contiguous())
    return {name: torch.stack(views) for name, views in drawn.items()}
