"""Texels as a list, tile after tile as in `ops.TexelTiles`, and as atlas pages.

In the list a surfel without a tile has one texel, its constant.
"""

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from bitymi_ns.ops import TexelAlpha, TexelTiles
from bitymi_ns.ops.baked_scene import alpha_means
from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.scene.baked import BakedScene
from .packing import Packing


def joined(colors: Tensor, alphas: Tensor | None) -> Tensor:
    """Join residual colours [n, 3] and alphas [n], if any, to texels [n, C]."""
    return colors if alphas is None else torch.cat([colors, alphas[:, None]], 1)


def size_classes(sizes: Tensor) -> list[tuple[int, int, Tensor]]:
    """Group the surfels with a tile by its size, of [N, 2], ascending: (r_u, r_v, rows [M] int64)."""
    # one integer per pair: torch.unique over rows is many times slower
    keys, inverse = torch.unique((sizes[:, 0].long() << 32) + sizes[:, 1].long(), return_inverse=True)
    pairs = torch.stack([keys >> 32, keys & 0xFFFFFFFF], dim=1)
    return [
        (int(r_u), int(r_v), torch.nonzero(inverse == i).squeeze(1))
        for i, (r_u, r_v) in enumerate(pairs.tolist())
        if r_u > 0 and r_v > 0
    ]


def listed_tiles(sizes: Tensor, chunk: int = 1 << 20) -> Iterator[tuple[tuple[int, int], Tensor, Tensor]]:
    """Yield the tiles of a texel list, given their sizes [N, 2], in chunks of one size and about `chunk` texels:
    (r_u, r_v), rows [n] int64 of the surfels, texel rows [n, r_v, r_u] int64."""
    first = first_texels(sizes)
    for r_u, r_v, members in size_classes(sizes):
        inside = torch.arange(r_u * r_v, device=sizes.device).view(r_v, r_u)
        for rows in members.split(max(1, chunk // (r_u * r_v))):
            yield (r_u, r_v), rows, first[rows, None, None] + inside


def first_texels(sizes: Tensor) -> Tensor:
    """Compute the row [N] int64 of each surfel's first texel in the list, from tile sizes [N, 2]."""
    area = sizes.long().clamp(min=1).prod(dim=1)
    return area.cumsum(0) - area


def texel_index(tiles: Tensor, size: tuple[int, int], width: int, height: int) -> Tensor:
    """Compute the flat index (layer * height + y) * width + x, [N, r_v, r_u] int64, of each texel of tiles [N, 5] int32
    (x, y, layer, r_u, r_v) of one size in pages of `width` x `height` texels."""
    x, y, layer = tiles[:, 0].long(), tiles[:, 1].long(), tiles[:, 2].long()
    origin = (layer * height + y) * width + x  # [N]
    i, j = (torch.arange(side, device=tiles.device) for side in size)
    return origin[:, None, None] + (j[:, None] * width + i[None, :])


def tile_means(texels: Tensor, sizes: Tensor) -> Tensor:
    """Compute the mean [N, C] of each tile of a texel list [T, C], given tile sizes [N, 2]; C = 4: as `alpha_means`."""
    means = texels[first_texels(sizes)]
    for _, rows, index in listed_tiles(sizes):
        values = texels[index]
        means[rows] = alpha_means(values, (1, 2)) if values.shape[3] == 4 else values.mean(dim=(1, 2))
    return means


def _texel_rows(packing: Packing) -> Iterator[tuple[Tensor, Tensor]]:
    """Yield matching rows of the texel list and of the flattened pages, one pair per chunk of tiles."""
    tiles = torch.from_numpy(packing.tiles)
    for size, rows, listed in listed_tiles(tiles[:, 3:]):
        paged = texel_index(tiles[rows], size, packing.width, packing.height)
        yield listed.reshape(-1), paged.reshape(-1)


def listed_texels(pages: Tensor, packing: Packing, constants: Tensor) -> Tensor:
    """Gather pages [layers, height, width, C] into a texel list [T, C]; `constants`: [N, C], of surfels
    without a tile."""
    area = torch.from_numpy(packing.tiles[:, 3:]).long().clamp(min=1).prod(dim=1)
    texels = constants.repeat_interleave(area, dim=0)
    for listed, paged in _texel_rows(packing):
        texels[listed] = pages.reshape(-1, pages.shape[3])[paged]
    return texels


def paged_texels(texels: Tensor, packing: Packing, elsewhere: float = 0.0) -> Tensor:
    """Scatter a texel list [T, ...] into pages [layers, height, width, ...], filled with `elsewhere` between tiles."""
    rest = texels.shape[1:]
    pages = texels.new_full((packing.layers, packing.height, packing.width, *rest), elsewhere)
    for listed, paged in _texel_rows(packing):
        pages.view(-1, *rest)[paged] = texels[listed]
    return pages


def texel_alpha(scene: BakedScene) -> TexelAlpha | None:
    """Return the alpha texels of a scene on its device, with mean alphas for surfels without a tile; None: no alpha.
    Raises ValueError: the atlas exists only as BC7 blocks."""
    alphas, device = scene.alphas(), scene.tiles.device
    if alphas is None and scene.mean_alpha is None:
        return None
    means = torch.ones(len(scene), dtype=torch.float32) if scene.mean_alpha is None else scene.mean_alpha.cpu()
    extent = torch.full_like(means, SUPPORT, device=device) if scene.extent is None else scene.extent.float()
    sizes, values = torch.ones_like(scene.tiles[:, 3:]), means  # without an atlas: constants only
    if alphas is not None:
        layers, height, width = alphas.shape
        packing = Packing(scene.tiles.cpu().numpy(), width, height, layers, 1.0)
        sizes = scene.tiles[:, 3:].clamp(min=1)
        values = listed_texels(alphas[..., None], packing, means[:, None])[:, 0]
    return TexelAlpha(TexelTiles.of_sizes(sizes, extent), values.contiguous().to(device), scene.weight_bound)


def covered_blocks(tiles: np.ndarray, width: int, height: int, layers: int) -> np.ndarray:
    """Compute the mask [layers, height / 4, width / 4] of 4 x 4 blocks that belong to a tile."""
    blocks = torch.from_numpy(np.ascontiguousarray(tiles)).clone()
    blocks[:, [0, 1, 3, 4]] //= 4
    mask = torch.zeros(layers * (height // 4) * (width // 4), dtype=torch.bool)
    for r_u, r_v, rows in size_classes(blocks[:, 3:]):
        mask[texel_index(blocks[rows], (r_u, r_v), width // 4, height // 4).reshape(-1)] = True
    return mask.reshape(layers, height // 4, width // 4).numpy()
