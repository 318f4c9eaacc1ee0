"""Drawing a baked scene with the CPU kernels: forward only, texels in place of the field, no fragment list."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor

from .backend import module, require
from .constants import BAKED_CHANNELS, MAP_CHANNELS, SUPPORT
from .project import Projection
from .trace_cpu import borrowed_tracer

ON_CUDA = "move the scene to the CPU, or draw with `baked.draw`"


def gather(atlas: Tensor | None, tiles: Tensor) -> Any:
    """The atlas as the kernel reads it, every surfel's tile in one run of memory.

    Args:
        atlas: [layers, height, width, 4] uint8 or float32 on the CPU; None = no tiles.
        tiles: [N, 5] int32: x, y, layer, r_u, r_v in texels; r_u = 0: no tile.

    Raises:
        ValueError: a tile does not lie on a page; names its surfel.
        RuntimeError: the tiles are not on the CPU.
    """
    require("baked_cpu.gather", "cpu", tiles.device, ON_CUDA)
    is_bytes = atlas is not None and atlas.dtype == torch.uint8
    shape = (0, 0, 0) if atlas is None else tuple(atlas.shape[:3])
    return module(tiles.device).Patches(
        atlas if is_bytes else None, None if is_bytes else atlas, shape, tiles.contiguous()
    )


def draw(
    projection: Projection,
    base: Tensor,
    patches: Any,
    offset: float,
    scale: float,
    extent: Tensor | None,
    mean_residual: Tensor | None,
    weight_bound: float,
    transmittance_min: float,
    maps: bool,
) -> tuple[Tensor, Tensor | None]:
    """Draws a view.

    Args:
        projection: of N surfels into an H x W view.
        base: [N, 3] f_view of every surfel.
        patches: of `gather`.
        offset, scale: residual = offset + scale * texel, a byte as 0 to 255.
        extent: [N] half side of the tile in scale units; None = the kernel's support.
        mean_residual: [N, 3] residual of surfels without a tile; None = 0.
        weight_bound: fragments of smaller weight get no residual.
        transmittance_min: a surfel that would leave a pixel less is not blended and ends the pixel; 0 = all are.
        maps: also beta, depth, normal and overdraw.

    Returns:
        [H, W, 4] rgb and alpha, with maps [H, W, 9]: also the sums of w beta, w z and w n. And with maps the blended
        surfels per pixel, [H, W, 1] int32. The background is not included.

    Raises:
        RuntimeError: the projection is not on the CPU.
    """
    geom, camera, n = projection.geom, projection.camera, len(projection.geom)
    require("baked_cpu.draw", "cpu", geom.device, ON_CUDA)
    size = (camera.width, camera.height)
    image = geom.new_empty(camera.height, camera.width, MAP_CHANNELS if maps else BAKED_CHANNELS)
    overdraw = torch.empty(camera.height, camera.width, 1, dtype=torch.int32) if maps else None
    with borrowed_tracer(geom) as tracer:
        tracer.run(geom, projection.radii, *size, projection.near, projection.through_pixel, fragments=False)
        tracer.baked(
            geom,
            projection.radii,
            *size,
            projection.near,
            projection.through_pixel,
            weight_bound,
            transmittance_min,
            maps,
            base,
            patches,
            offset,
            scale,
            torch.full((n,), SUPPORT) if extent is None else extent,
            torch.zeros(n, 3) if mean_residual is None else mean_residual,
            image,
            overdraw,
        )
    return image, overdraw
