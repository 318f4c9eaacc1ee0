"""Coarser levels of texture tiles, for views in which a texel is smaller than a pixel."""

from __future__ import annotations

from collections.abc import Iterator

import torch
from torch import Tensor

LEVELS = ("half", "quarter")
"""Names of the levels: what is left of a side."""


def halved(atlas: Tensor) -> Tensor:
    """Means of 2 x 2 texels, those of bytes rounded: [layers, height / 2, width / 2, 4] of [layers, height, width, 4];
    an odd row or column is left out."""
    layers, height, width, channels = atlas.shape
    cut = atlas[:, : height // 2 * 2, : width // 2 * 2].reshape(layers, height // 2, 2, width // 2, 2, channels)
    if atlas.dtype == torch.uint8:
        return ((cut.to(torch.int16).sum((2, 4), dtype=torch.int16) + 2) >> 2).to(torch.uint8)
    return cut.mean((2, 4))


def tile_levels(atlas: Tensor, tiles: Tensor) -> Iterator[tuple[str, Tensor, Tensor]]:
    """The levels of an atlas, finest first, without that of the atlas itself.

    Args:
        atlas: [layers, height, width, 4] uint8 or float.
        tiles: [N, 5] int32: x, y, layer, r_u, r_v in texels.

    Yields:
        name, pages, and the tiles on them: r_u = 0 where a tile has no such level, because its corner or its sides do
        not lie on the grid of the level. A bundle's tiles lie on a grid of four texels, so each has both levels.
    """
    scaled = tiles.new_tensor([1, 1, 0, 1, 1])
    for level, name in enumerate(LEVELS, start=1):
        atlas = halved(atlas)
        if 0 in atlas.shape:
            return
        fits = (tiles * scaled % (1 << level) == 0).all(1, keepdim=True)
        yield name, atlas.contiguous(), torch.where(fits, tiles >> (level * scaled), 0).contiguous()
