"""Errors of texels as the closest training view shows them, times the blending weight and averaged over each pixel, and
the certificate of those of quantisation."""

from collections.abc import Mapping, Sequence
from itertools import chain

import torch
from torch import Tensor

from bitymi_ns.bundle.statistics import Certificate
from bitymi_ns.codec.pages import first_texels, listed_tiles
from bitymi_ns.codec.quantise import STEPS
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.tile_sizes import kernel_parameters, max_projected_extent
from bitymi_ns.train.init import tangents
from .stages import Coded
from .tiles import TileVisibility, weighted_rms, weights

_CONSTANT = (8, 8)  # grid on which the weight of a surfel without a tile is evaluated


@torch.no_grad()
def listed_errors(
    difference: Tensor, sizes: Tensor, shown: TileVisibility, chunk: int = 1 << 18
) -> tuple[Tensor, Tensor]:
    """Measure differences [T, 3] of texels (`Stage.texels`) as the closest training view shows them. `sizes`: [N, 2] of
    the tiles; (0, 0) = none. `shown`: N rows. `chunk`: texels taken at once.

    Returns [N] root mean squares, 8-bit steps, of the differences times the largest blending weight at the texel; and
    [N] bool, whether any fragment of the surfel gets a residual."""
    errors = torch.zeros(len(sizes))
    seen = torch.zeros(len(sizes), dtype=torch.bool)
    first = first_texels(sizes)
    bare = torch.nonzero(sizes[:, 0] == 0).squeeze(1)
    constants = (
        (_CONSTANT, rows, first[rows, None, None].expand(-1, *_CONSTANT)) for rows in bare.split(max(1, chunk // 64))
    )
    for size, rows, index in chain(listed_tiles(sizes, chunk), constants):
        weight = weights(shown, rows, size)
        away = difference[index].permute(0, 3, 1, 2) * weight[:, None]
        errors[rows] = weighted_rms(moving_average(away, cells_per_pixel(shown, rows, size)), (weight > 0).float())
        seen[rows] = (weight > 0).flatten(1).any(1)
    return errors, seen


def closest_pixels(surfels: Mapping[str, Tensor], cameras: Sequence[Camera], extent: float, near: float) -> Tensor:
    """Compute the pixels per scale unit [N, 2] along u and v in the view that shows a surfel largest; 0 if its square
    of half side `extent`, scale units, meets no image. `near`: camera z."""
    axes = tangents(surfels["quats"])
    scales = surfels["log_scales"].exp()
    return max_projected_extent(surfels["means"], axes, scales, cameras, extent, near) / (2.0 * extent)


def cells_per_pixel(shown: TileVisibility, rows: Tensor, size: tuple[int, int]) -> Tensor:
    """Compute how many cells [n, 2] of a grid of `size` (u, v) a pixel of the closest view covers in tiles `rows`, from
    1 to the side of the grid; 1 if the view is unknown."""
    extent = shown.extent[rows]
    sides = torch.tensor(size, dtype=torch.float32, device=extent.device).expand(len(extent), 2)
    if shown.pixels is None:
        return torch.ones_like(sides)
    covered = sides / (2.0 * extent[:, None] * shown.pixels[rows]).clamp(min=1e-9)
    return torch.minimum(covered.clamp(min=1.0), sides)


def moving_average(values: Tensor, cells: Tensor) -> Tensor:
    """Average values [n, c, v, u] over a rectangle about every cell, moved into the grid. `cells`: [n, 2] sides of the
    rectangles along u and v, as of `cells_per_pixel`."""
    along_u, along_v = (_windows(values.shape[axis], cells[:, i]) for axis, i in ((3, 0), (2, 1)))
    across = torch.einsum("nij,ncvj->ncvi", along_u, values)
    return torch.einsum("nij,ncju->nciu", along_v, across)


def _windows(count: int, width: Tensor) -> Tensor:
    """Build matrices [n, count, count] of a moving average with windows of `width` [n] cells."""
    edge = torch.arange(count, device=width.device, dtype=torch.float32)
    half = width[:, None] / 2
    center = torch.minimum(torch.maximum(edge + 0.5, half), count - half)  # [n, count]
    low, high = (center - half)[:, :, None], (center + half)[:, :, None]
    return (torch.minimum(high, edge + 1) - torch.maximum(low, edge)).clamp(min=0) / width[:, None, None]


@torch.no_grad()
def certified(baked: Coded, cameras: Sequence[Camera]) -> Coded:
    """State the error of quantised residual colours, as training views see it, in the statistics, without alphas. A
    bake without texels or tolerance is returned as it is."""
    scene, options = baked.scene, baked.options
    if baked.atlas is None or options.tolerance == 0:
        return baked
    difference = baked.shown[:, :3] - baked.texels[:, :3]
    cameras = [camera.to("cpu") for camera in cameras]
    pixels = closest_pixels(scene.surfels, cameras, options.extent, scene.near) if cameras else None
    opacity, beta = kernel_parameters(scene.surfels, baked.in_front)
    shown = TileVisibility(opacity, beta, baked.extent, scene.weight_bound, pixels=pixels)
    errors, seen = listed_errors(difference, baked.sizes, shown)
    rms = STEPS * float(difference.double().square().mean().sqrt())
    return baked.stating(certificate=Certificate.of(errors[seen], options.tolerance).replace(texel_rms=round(rms, 4)))
