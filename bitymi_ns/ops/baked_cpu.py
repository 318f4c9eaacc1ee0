"""Rendering of baked scenes with the CPU kernels, without a fragment list."""

from collections.abc import Sequence
from typing import Any

import torch
from torch import Tensor

from .backend import kernel, lookup
from .baked_scene import BakedSceneLike, residual, tile_levels
from .constants import BAKED_CHANNELS, MAP_CHANNELS
from .project import CameraLike, geometry_of, project
from .trace_cpu import tile_lists
from .view_color import view_color

CHANNELS = {"rgb": slice(0, 3), "alpha": slice(3, 4), "beta": slice(4, 5), "depth": slice(5, 6), "normal": slice(6, 9)}
"""Channels of a frame by image; without maps only the first two."""


def gather(atlas: Tensor | None, tiles: Tensor) -> Any:
    """Gather each surfel's tile, of `BakedScene`'s atlas and tiles, into contiguous memory, as the kernel reads it.
    Raises ValueError: the tile of a surfel lies outside its page."""
    layers, height, width = (0, 0, 0) if atlas is None else atlas.shape[:3]
    texels = {} if atlas is None else {"bytes" if atlas.dtype == torch.uint8 else "floats": atlas}
    patches = lookup("Patches", tiles.device)
    return patches(**texels, layers=layers, height=height, width=width, tiles=tiles.contiguous())


def coarser(atlas: Tensor, tiles: Tensor, alpha: bool) -> dict[str, Any]:
    """Gather the coarser levels of an atlas for the kernel, by name."""
    return {name: gather(pages, placed) for name, pages, placed in tile_levels(atlas, tiles, alpha)}


def frame(
    scene: BakedSceneLike, camera: CameraLike, maps: bool, photo_pixel: float = 1.0
) -> tuple[Tensor, Tensor | None]:
    """Draw a view without background; `photo_pixel`: as in `baked.draw`.

    Returns:
        [H, W, 4] rgb and alpha, or [H, W, 9] with maps, adding the sums of w beta, w z and w n; and with maps the
        number of blended surfels per pixel, [H, W, 1] int32.

    Raises:
        ValueError: the atlas exists only as BC7 blocks.
    """
    atlas, tiles, p = scene.atlas, scene.tiles, scene.surfels
    if atlas is None and scene.blocks is not None:
        raise ValueError("the CPU needs decoded texels: read the bundle with decode=True")
    projection = project(*geometry_of(p), camera=camera, near=scene.near, photo_pixel=photo_pixel)
    geom = projection.geom
    texture = residual(scene)
    if atlas is not None and atlas.dtype == torch.uint8:
        texture |= {name: texture[name] / 255 for name in ("scale", "alpha_scale")}  # the kernel reads 0 to 255
    image = geom.new_empty(camera.height, camera.width, MAP_CHANNELS if maps else BAKED_CHANNELS)
    overdraw = torch.empty(camera.height, camera.width, 1, dtype=torch.int32) if maps else None
    patches = scene.cache.atlas(lambda: gather(atlas, tiles), atlas, tiles)
    levels = {}
    if atlas is not None and photo_pixel < 1.0:
        levels = scene.cache.coarser(lambda: coarser(atlas, tiles, scene.alpha_scale > 0))
    with tile_lists().borrow() as bins:
        kernel("baked_forward", geom)(
            **projection.view(geom),
            **texture,
            base=view_color(scene.view_color, p, p["means"], camera.exact_center, projection.visible),
            patches=patches,
            **levels,
            bins=bins,
            maps=maps,
            image=image,
            overdraw=overdraw,
        )
    return image, overdraw


def draw(
    scene: BakedSceneLike,
    cameras: Sequence[CameraLike],
    background: Tensor | None,
    images: Sequence[str],
    photo_pixel: float = 1.0,
) -> dict[str, Tensor]:
    """Draw views one by one; see `baked.draw`."""
    drawn: dict[str, list[Tensor]] = {name: [] for name in images}
    for camera in cameras:
        maps = any(name not in ("rgb", "alpha") for name in images)
        image, overdraw = frame(scene, camera, maps, photo_pixel)
        for name, views in drawn.items():
            view = overdraw if name == "overdraw" and overdraw is not None else image[..., CHANNELS[name]]
            if name == "rgb" and background is not None:
                view = view + (1 - image[..., CHANNELS["alpha"]]) * background
            views.append(view)
    return {name: views[0][None] if len(views) == 1 else torch.stack(views) for name, views in drawn.items()}
