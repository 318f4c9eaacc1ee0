"""Texels as a list, tile after tile as in `ops.TexelTiles`, and as pages of an atlas.

In the list a surfel without a tile has one texel, its constant.
"""

from collections.abc import Iterator

import numpy as np
import torch
from torch import Tensor

from bitymi_ns.codec.packing import Packing
from bitymi_ns.ops import TexelAlpha, TexelTiles
from bitymi_ns.ops.baked_scene import alpha_means
from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.scene.baked import BakedScene


def size_classes(sizes: Tensor) -> list[tuple[int, int, Tensor]]:
    """Surfels grouped by the sizes [N, 2] (r_u, r_v) of their tiles.

    Returns:
        a list of (r_u, r_v, rows [M] int64), sizes ascending; surfels without a tile are left out.
    """
    # as one number each: torch.unique of rows sorts them many times as slowly
    keys, inverse = torch.unique((sizes[:, 0].long() << 32) + sizes[:, 1].long(), return_inverse=True)
    found = torch.stack([keys >> 32, keys & 0xFFFFFFFF], dim=1)
    return [
        (int(r_u), int(r_v), torch.nonzero(inverse == i).squeeze(1))
        for i, (r_u, r_v) in enumerate(found.tolist())
        if r_u > 0 and r_v > 0
    ]


def listed_tiles(sizes: Tensor, chunk: int = 1 << 20) -> Iterator[tuple[tuple[int, int], Tensor, Tensor]]:
    """Tiles of a texel list, in chunks of one size; surfels without a tile, which have one texel, are left out.

    Args:
        sizes: [N, 2] (r_u, r_v) of the tiles.
        chunk: texels at once (a tile is never split).

    Yields:
        (r_u, r_v), rows [n] int64 of the surfels, rows [n, r_v, r_u] int64 of their texels.
    """
    first = first_texels(sizes)
    for r_u, r_v, members in size_classes(sizes):
        inside = torch.arange(r_u * r_v, device=sizes.device).view(r_v, r_u)
        for rows in members.split(max(1, chunk // (r_u * r_v))):
            yield (r_u, r_v), rows, first[rows, None, None] + inside


def first_texels(sizes: Tensor) -> Tensor:
    """[N] int64 row of the first texel of every surfel in the list, of the sizes [N, 2] of the tiles."""
    area = sizes.long().clamp(min=1).prod(dim=1)
    return area.cumsum(0) - area


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


def tile_means(texels: Tensor, sizes: Tensor) -> Tensor:
    """[N, C] mean of every tile of a texel list [T, C], of sizes [N, 2]; of a surfel without a tile its texel. Colours
    are weighted by alpha, where there is a fourth channel and not all of it is 0."""
    means = texels[first_texels(sizes)]
    for _, rows, index in listed_tiles(sizes):
        values = texels[index]
        means[rows] = alpha_means(values, (1, 2)) if values.shape[3] == 4 else values.mean(dim=(1, 2))
    return means


def _texel_rows(packing: Packing) -> Iterator[tuple[Tensor, Tensor]]:
    """Rows of the texel list and of the flattened pages of the same texels, a pair for each chunk of tiles."""
    tiles = torch.from_numpy(packing.tiles)
    for size, rows, listed in listed_tiles(tiles[:, 3:]):
        paged = texel_index(tiles[rows], size, packing.width, packing.height)
        yield listed.reshape(-1), paged.reshape(-1)


def listed_texels(pages: Tensor, packing: Packing, constants: Tensor) -> Tensor:
    """Texel list [T, C] of pages [layers, height, width, C]; a surfel without a tile has its constant of [N, C]."""
    area = torch.from_numpy(packing.tiles[:, 3:]).long().clamp(min=1).prod(dim=1)
    texels = constants.repeat_interleave(area, dim=0)
    for listed, paged in _texel_rows(packing):
        texels[listed] = pages.reshape(-1, pages.shape[3])[paged]
    return texels


def paged_texels(texels: Tensor, packing: Packing, elsewhere: float = 0.0) -> Tensor:
    """Pages [layers, height, width, ...] of a texel list [T, ...], with a number outside of tiles."""
    rest = texels.shape[1:]
    pages = texels.new_full((packing.layers, packing.height, packing.width, *rest), elsewhere)
    for listed, paged in _texel_rows(packing):
        pages.view(-1, *rest)[paged] = texels[listed]
    return pages


def scene_texels(scene: BakedScene) -> Tensor:
    """[T, 3] residual colours of a scene on the CPU; a surfel without a tile has one, its mean residual."""
    assert scene.mean_residual is not None
    if scene.atlas is None and scene.blocks is None:
        return scene.mean_residual
    return _listed(scene, scene.residuals(), scene.mean_residual)


def texel_alpha(scene: BakedScene) -> TexelAlpha | None:
    """Alpha texels of a scene for its projections, on its device; a surfel without a tile has one, its mean alpha.
    None = the scene has no alpha.

    Raises:
        ValueError: the atlas is only there as BC7 blocks.
    """
    alphas, device = scene.alphas(), scene.tiles.device
    if alphas is None and scene.mean_alpha is None:
        return None
    means = torch.ones(len(scene)) if scene.mean_alpha is None else scene.mean_alpha.cpu()
    extent = torch.full_like(means, SUPPORT, device=device) if scene.extent is None else scene.extent.float()
    if alphas is None:  # without an atlas every surfel has its constant
        sizes, values = torch.ones_like(scene.tiles[:, 3:]), means
    else:
        sizes, values = scene.tiles[:, 3:].clamp(min=1), _listed(scene, alphas[..., None], means[:, None])[:, 0]
    return TexelAlpha(TexelTiles.of_sizes(sizes, extent), values.contiguous().to(device), scene.weight_bound)


def _listed(scene: BakedScene, pages: Tensor, constants: Tensor) -> Tensor:
    layers, height, width = pages.shape[:3]
    return listed_texels(pages, Packing(scene.tiles.cpu().numpy(), width, height, layers, 1.0), constants)


def covered_blocks(tiles: np.ndarray, width: int, height: int, layers: int) -> np.ndarray:
    """[layers, height / 4, width / 4] bool, True for 4 x 4 blocks that belong to a tile."""
    blocks = torch.from_numpy(np.ascontiguousarray(tiles)).clone()
    blocks[:, [0, 1, 3, 4]] //= 4
    mask = torch.zeros(layers * (height // 4) * (width // 4), dtype=torch.bool)
    for r_u, r_v, rows in size_classes(blocks[:, 3:]):
        mask[texel_index(blocks[rows], (r_u, r_v), width // 4, height // 4).reshape(-1)] = True
    return mask.reshape(layers, height // 4, width // 4).numpy()
