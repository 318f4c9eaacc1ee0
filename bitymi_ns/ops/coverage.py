"""Sum a view's blending weights by surfel and by texel (coverage): on the CPU as fragments are found, on a CUDA device
from lists."""

from typing import Any

import torch
from torch import Tensor

from .backend import cuda_backend, kernel
from .bands import fitting_lists
from .blend import backward_memory
from .constants import GEOM, IMAGE_CHANNELS
from .project import Projection
from .texel import TexelTiles
from .trace import Fragments
from .trace_cpu import tile_lists

PART = 1 << 20  # fragments summed at a time


@torch.no_grad()
def surfel_coverage(projection: Projection, bound: float) -> Tensor:
    """Measure the coverage of each surfel in a view. Returns [N, 3]: largest transmittance in front of a blended
    fragment; sum of blending weights >= `bound`, and of all squared blending weights, pixels. 0 if not blended."""
    geom = projection.geom.detach()
    shown = geom.new_zeros(len(geom), 3)
    if not cuda_backend(geom.device):
        _sum_fragments("surfel_coverage", projection, bound, shown=shown)
        return shown
    largest, weights, squares = shown.unbind(1)
    for fragments in fitting_lists(projection):
        lists = (fragments.surfel, fragments.weight, fragments.sigma)
        for surfel, weight, sigma in zip(*(values.split(PART) for values in lists), strict=True):
            rows = surfel.long()
            largest.scatter_reduce_(0, rows, weight / sigma.abs(), "amax")  # sigma < 0 flags the low-pass branch
            weights.index_add_(0, rows, torch.where(weight >= bound, weight, 0.0).to(shown.dtype))
            squares.index_add_(0, rows, weight.square())
        del fragments, lists, surfel, weight, sigma  # frees memory before the next list
    return shown


@torch.no_grad()
def add_texel_coverage(
    projection: Projection, tiles: TexelTiles, mask: Tensor | None, bound: float, covered: Tensor
) -> None:
    """Add the coverage of each texel in a view, in pixels.

    Args:
        mask: [H, W] or [H, W, 1] bool, True for pixels that count; None: all.
        bound: fragments of smaller weight are ignored.
        covered: [T, 2] of the tiles' dtype, contiguous; increased by the sums over fragments of w b and w^2 b, with
            blending weight w and bilinear weight b.
    """
    counts = None if mask is None else mask.to(covered.device).reshape(-1)
    if not cuda_backend(covered.device):
        flat = {} if counts is None else {"mask": counts.view(torch.uint8).contiguous()}
        of_tiles = {f"covered_{name}": value for name, value in tiles.arrays.items()}
        _sum_fragments("texel_coverage", projection, bound, covered=covered, **of_tiles, **flat)
        return
    top = 0
    total = covered.new_zeros(len(covered), 3)
    squares = covered.new_zeros(len(covered))
    for fragments in fitting_lists(projection):
        pixels = fragments.width * fragments.height
        _add_of_list(fragments, tiles, None if counts is None else counts[top : top + pixels], bound, total, squares)
        top += pixels
        del fragments  # before the next list is made
    covered += torch.stack([total[:, 0], squares], 1)


def _sum_fragments(name: str, projection: Projection, bound: float, **arguments: Any) -> None:
    geom = projection.geom.detach()
    with tile_lists().borrow() as bins:
        kernel(name, geom)(**projection.view(geom), **projection.alpha_arrays, bound=bound, bins=bins, **arguments)


def _add_of_list(
    fragments: Fragments, tiles: TexelTiles, mask: Tensor | None, bound: float, total: Tensor, squares: Tensor
) -> None:
    """Add the coverage by listed fragments to total [T, 3] (equal columns) and squares [T]: a backward pass of blending
    with image gradient 1 and texel rate -1."""
    like = tiles.extent
    surfels = fragments.surfels
    pixels = fragments.width * fragments.height
    counts = like.new_ones(pixels) if mask is None else mask.to(like.dtype)
    base, geom = like.new_zeros(surfels, 3), like.new_zeros(surfels, GEOM)
    kernel("blend_backward", total)(
        **fragments.arrays,
        **tiles.arrays,
        **backward_memory(fragments, False, len(total)),
        **fragments.view,
        texels=total,
        moved=total,
        squares=squares,
        share=like.new_ones(tiles.count),
        rate=-1.0,
        maps=False,
        bound=bound,
        base=base,
        geom=geom,
        dimage=torch.nn.functional.pad(counts[:, None].expand(-1, 3), (0, IMAGE_CHANNELS - 3)),
        dgeom=torch.empty_like(geom),
        dbase=torch.empty_like(base),
    )
