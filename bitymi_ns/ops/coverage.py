"""Coverage: how much of a view's picture every texel makes up, which decides how far it moves in a step."""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor

from .backend import cuda_backend, dense, kernel
from .constants import GEOM, IMAGE_CHANNELS
from .texel import TexelTiles, backward_memory
from .trace import Fragments


def add_texel_coverage(
    lists: Iterable[Fragments],
    tiles: TexelTiles,
    mask: Tensor | None,
    bound: float,
    total: Tensor | None,
    squares: Tensor | None = None,
) -> None:
    """Adds to every texel how much of a view's picture it makes up, in pixels: the sum over the fragments of the
    blending weight times the bilinear weight.

    Args:
        lists: the fragments of an H x W view, from top to bottom, as of `fitting_lists`.
        tiles: where the T texels lie.
        mask: [H, W] or [H, W, 1] bool, True where the pixel counts; None = everywhere.
        bound: fragments of weight below this count as nothing.
        total: [T, 3] of the tiles' dtype, dense, added to, alike in all columns; None = not wanted.
        squares: [T, 3], added to: the same of the blending weights' squares. None = not wanted.
    """
    like, top = tiles.extent, 0
    share = like.new_ones(tiles.count)
    mask = None if mask is None else mask.to(like.device).reshape(-1)
    for fragments in lists:
        pixels = fragments.width * fragments.height
        counts = like.new_ones(pixels) if mask is None else mask[top : top + pixels].to(like.dtype)
        weight = dense(fragments.weight, like)
        if total is not None:
            _add(fragments, weight, tiles, counts, bound, total, share)
        if squares is not None:
            _add(fragments, weight.square(), tiles, counts, bound * bound, squares, share)
        top += pixels
        del fragments, weight  # before the next list is made


def _add(
    fragments: Fragments, weight: Tensor, tiles: TexelTiles, counts: Tensor, bound: float, total: Tensor, share: Tensor
) -> None:
    """The same of one list with these weights, and for every pixel what it counts [H * W]: the gradient of colours of
    which no channel is cut off, as a step of length -1 by a share [T] of 1."""
    base = total.new_zeros(fragments.surfels, 3)
    step = {"base": base, "texels": total, "moved": total, "share": share, "rate": -1.0, "dtexels": None, "duv": None}
    given = {**fragments.arrays_for_layout, **tiles.arrays, **step, "weight": weight, "bound": bound}
    if cuda_backend(total.device):
        # as colours, too: where they are 0 there is nothing to count
        grey = (weight * counts[fragments.pixel.long()])[:, None].expand(-1, 3).contiguous()
        memory = backward_memory(total, len(base), True)
        kernel("texel_colors_backward", total)(**given, **memory, colors=grey, dcolors=grey, dbase=None)
        return
    dimage = torch.nn.functional.pad(counts[:, None].expand(-1, 3), (0, IMAGE_CHANNELS - 3))
    geom = total.new_zeros(fragments.surfels, GEOM)
    view = {"maps": False, "width": fragments.width, "height": fragments.height, "layout": fragments.layout}
    unused = {"dweight": torch.empty_like(weight), "ddepth": None, "dgeom": geom.clone(), "dbase": base.clone()}
    kernel("blend_backward", total)(**given, **view, **unused, geom=geom, dimage=dimage)
