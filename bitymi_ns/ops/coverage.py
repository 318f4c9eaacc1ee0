"""Coverage of texels: the pixels of a view that each texel accounts for, which weight its step."""

from collections.abc import Iterable

import torch
from torch import Tensor

from .backend import kernel
from .blend import backward_memory
from .constants import GEOM, IMAGE_CHANNELS
from .texel import TexelTiles
from .trace import Fragments


def add_texel_coverage(
    lists: Iterable[Fragments],
    tiles: TexelTiles,
    mask: Tensor | None,
    bound: float,
    total: Tensor,
    squares: Tensor | None = None,
) -> None:
    """Add the coverage of each texel in a view, in pixels: sum over fragments of blending weight times bilinear weight.

    Args:
        lists: fragments of an H x W view from top to bottom, as from `fitting_lists`.
        tiles: of the T texels.
        mask: [H, W] or [H, W, 1] bool, True for pixels that count; None: all.
        bound: fragments of smaller weight are ignored.
        total: [T, 3] of the tiles' dtype, dense, equal columns, added to.
        squares: [T], added to: the same sum with squared blending weights; None: skip.
    """
    like, top = tiles.extent, 0
    mask = None if mask is None else mask.to(like.device).reshape(-1)
    # a step of length -1 for colours with no clamped channel
    step = {"texels": total, "moved": total, "squares": squares, "share": like.new_ones(tiles.count), "rate": -1.0}
    for fragments in lists:
        pixels, surfels = fragments.width * fragments.height, fragments.surfels
        counts = like.new_ones(pixels) if mask is None else mask[top : top + pixels].to(like.dtype)
        base, geom = like.new_zeros(surfels, 3), like.new_zeros(surfels, GEOM)
        kernel("blend_backward", total)(
            **fragments.arrays,
            **tiles.arrays,
            **step,
            **backward_memory(fragments, False, len(total)),
            **fragments.view,
            maps=False,
            bound=bound,
            base=base,
            geom=geom,
            dimage=torch.nn.functional.pad(counts[:, None].expand(-1, 3), (0, IMAGE_CHANNELS - 3)),
            dgeom=torch.empty_like(geom),
            dbase=torch.empty_like(base),
        )
        top += pixels
        del fragments  # before the next list is made
