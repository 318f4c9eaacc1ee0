"""Indices of texels in the pages of an atlas, and texels as a list and as pages."""

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from bitymi_ns.codec.packing import Packing
from bitymi_ns.ops.baked_scene import alpha_means


def size_classes(tiles: Tensor) -> list[tuple[int, int, Tensor]]:
    """Tiles grouped by size.

    Args:
        tiles: [N, 5] int32 (x, y, layer, r_u, r_v).

    Returns:
        a list of (r_u, r_v, rows [M] int64), sizes ascending; surfels without a tile are left out.
    """
    # as one number each: torch.unique of rows sorts them many times as slowly
    keys, inverse = torch.unique((tiles[:, 3].long() << 32) + tiles[:, 4].long(), return_inverse=True)
    sizes = torch.stack([keys >> 32, keys & 0xFFFFFFFF], dim=1)
    return [
        (int(r_u), int(r_v), torch.nonzero(inverse == i).squeeze(1))
        for i, (r_u, r_v) in enumerate(sizes.tolist())
        if r_u > 0 and r_v > 0
    ]


def texel_index(tiles: Tensor, size: tuple[int, int], width: int, height: int) -> Tensor:
    """Flat index, (layer * height + y) * width + x, of every texel of tiles that share one size.

    Args:
        tiles: [N, 5] int32 (x, y, layer, r_u, r_v).
        size: (r_u, r_v).
        width, height: page size in texels.

    Returns:
        [N, r_v, r_u] int64.
    """
    x, y, layer = tiles[:, 0].long(), tiles[:, 1].long(), tiles[:, 2].long()
    origin = (layer * height + y) * width + x  # [N]
    i, j = (torch.arange(side, device=tiles.device) for side in size)
    return origin[:, None, None] + (j[:, None] * width + i[None, :])


def tile_means(texels: Tensor, packing: Packing, constant: Tensor | None = None, chunk: int = 1 << 20) -> Tensor:
    """[N, C] mean of every tile of `texels` [layers, height, width, C]; without a tile `constant` [N, C], or 0.
    Colours are weighted by alpha, where there is a fourth channel and not all of it is 0."""
    tiles = torch.from_numpy(packing.tiles)
    flat = texels.reshape(-1, texels.shape[3])
    means = torch.zeros(len(tiles), texels.shape[3]) if constant is None else constant.clone()
    for r_u, r_v, rows in size_classes(tiles):
        for part in rows.split(max(1, chunk // (r_u * r_v))):
            index = texel_index(tiles[part], (r_u, r_v), packing.width, packing.height)
            values = flat[index]
            means[part] = alpha_means(values, (1, 2)) if values.shape[3] == 4 else values.mean(dim=(1, 2))
    return means


def _texel_rows(packing: Packing) -> Iterator[tuple[Tensor, Tensor]]:
    """Rows of a texel list (`ops.TexelTiles`: a surfel without a tile has one texel) and rows of the flattened pages of
    the same texels, a pair for each tile size."""
    tiles = torch.from_numpy(packing.tiles)
    area = tiles[:, 3:].long().clamp(min=1).prod(dim=1)
    first = area.cumsum(0) - area
    for r_u, r_v, rows in size_classes(tiles):
        listed = first[rows, None] + torch.arange(r_u * r_v)
        paged = texel_index(tiles[rows], (r_u, r_v), packing.width, packing.height)
        yield listed.reshape(-1), paged.reshape(-1)


def listed_texels(pages: Tensor, packing: Packing, constants: Tensor) -> Tensor:
    """Texel list [T, C] of pages [layers, height, width, C]; a surfel without a tile has its constant of [N, C]."""
    area = torch.from_numpy(packing.tiles[:, 3:]).long().clamp(min=1).prod(dim=1)
    texels = constants.repeat_interleave(area, dim=0)
    for listed, paged in _texel_rows(packing):
        texels[listed] = pages.reshape(-1, pages.shape[3])[paged]
    return texels


def paged_texels(texels: Tensor, packing: Packing, elsewhere: Tensor | float = 0.0) -> Tensor:
    """Pages [layers, height, width, ...] of a texel list [T, ...]; outside of tiles a number, or texels of pages."""
    size, rest = (packing.layers, packing.height, packing.width), texels.shape[1:]
    pages = elsewhere.clone() if isinstance(elsewhere, Tensor) else texels.new_full((*size, *rest), elsewhere)
    for listed, paged in _texel_rows(packing):
        pages.view(-1, *rest)[paged] = texels[listed]
    return pages


def covered_blocks(tiles: np.ndarray, width: int, height: int, layers: int) -> np.ndarray:
    """[layers, height / 4, width / 4] bool, True for 4 x 4 blocks that belong to a tile."""
    blocks = torch.from_numpy(np.ascontiguousarray(tiles)).clone()
    blocks[:, [0, 1, 3, 4]] //= 4
    mask = torch.zeros(layers * (height // 4) * (width // 4), dtype=torch.bool)
    for r_u, r_v, rows in size_classes(blocks):
        mask[texel_index(blocks[rows], (r_u, r_v), width // 4, height // 4).reshape(-1)] = True
    return mask.reshape(layers, height // 4, width // 4).numpy()
