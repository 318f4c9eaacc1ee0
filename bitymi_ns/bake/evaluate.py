"""Evaluation of the residual field at the texel centres of every tile."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from bitymi_ns.bake.geometry import tangent_vectors, tile_points
from bitymi_ns.bake.packing import Packing
from bitymi_ns.ops.backend import cuda_backend
from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.ops.field_tiles import field_tiles
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.field import HashField


def size_classes(tiles: Tensor) -> list[tuple[int, int, Tensor]]:
    """Tiles grouped by size.

    Args:
        tiles: [N, 5] int32 (x, y, layer, r_u, r_v).

    Returns:
        a list of (r_u, r_v, rows [M] int64), sizes ascending; surfels without a tile are left out.
    """
    sizes, inverse = torch.unique(tiles[:, 3:], dim=0, return_inverse=True)
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
    i, j = torch.arange(size[0]), torch.arange(size[1])
    return origin[:, None, None] + (j[:, None] * width + i[None, :])


@torch.no_grad()
def evaluate_tiles(
    field: Callable[[Tensor], Tensor],
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    packing: Packing,
    extent: float = SUPPORT,
    chunk: int = 1 << 18,
    progress: Progress = no_progress,
) -> tuple[Tensor, int]:
    """The residual colour at every texel centre, written into pages (paper, section Texture Baking).

    u = (i + 0.5) / r_u * 2e - e and the same for v, lifted to x = mean + u s_u R[:,0] + v s_v R[:,1].

    Args:
        field: residual colour, [M, 3] world positions to [M, 3].
        means, quats, scales: [N, 3], [N, 4] wxyz, [N, 2] of the surfels, world frame.
        packing: where the tiles lie, N rows.
        extent: half side of a tile in scale units.
        chunk: texels evaluated at once (a tile is never split).
        progress: called with the number of texels done.

    Returns:
        texels: [layers, height, width, 3] float32 on the CPU; 0 (no residual) outside the tiles and where the field
            is not finite.
        nonfinite: number of texels whose value was not finite.
    """
    axes = tangent_vectors(quats) * scales[:, None, :]  # [N, 3, 2]
    if isinstance(field, HashField) and cuda_backend(means.device):
        return _evaluate_on_device(field, means, axes, packing, extent, progress)
    tiles = torch.from_numpy(packing.tiles)
    pages = torch.zeros(packing.layers * packing.height * packing.width, 3)
    total = int(tiles[:, 3:].long().prod(dim=1).sum())
    done, nonfinite = 0, 0
    for r_u, r_v, rows in size_classes(tiles):
        for part in rows.split(max(1, chunk // (r_u * r_v))):
            at = part.to(means.device)
            x = tile_points(means[at], axes[at], (r_u, r_v), extent)  # [n, r_v, r_u, 3]
            value = field(x.reshape(-1, 3)).float().cpu()  # [n r_v r_u, 3]
            bad = ~torch.isfinite(value).all(dim=1)
            if bad.any():
                nonfinite += int(bad.sum())
                value = value.masked_fill(bad[:, None], 0.0)
            pages[texel_index(tiles[part], (r_u, r_v), packing.width, packing.height).reshape(-1)] = value
            done += len(value)
            progress("evaluating texels", done, total)
    return pages.reshape(packing.layers, packing.height, packing.width, 3), nonfinite


def _evaluate_on_device(
    field: HashField, means: Tensor, axes: Tensor, packing: Packing, extent: float, progress: Progress
) -> tuple[Tensor, int]:
    """`evaluate_tiles` in one call, by the kernel that writes straight into the pages."""
    tiles = torch.from_numpy(packing.tiles)
    frames = torch.cat([means, axes[:, :, 0], axes[:, :, 1]], dim=1)
    pages = (packing.layers, packing.height, packing.width)
    half = means.new_full((len(means),), extent)
    texels, nonfinite = field_tiles(frames, half, tiles, pages, field.geometry, *field.weights)
    total = int(tiles[:, 3:].long().prod(dim=1).sum())
    progress("evaluating texels", total, total)
    return texels.float().cpu(), int(nonfinite)


def tile_means(texels: Tensor, packing: Packing, chunk: int = 1 << 20) -> Tensor:
    """Mean of every tile of `texels` [layers, height, width, 3]: [N, 3], 0 without a tile."""
    tiles = torch.from_numpy(packing.tiles)
    flat = texels.reshape(-1, 3)
    means = torch.zeros(len(tiles), 3)
    for r_u, r_v, rows in size_classes(tiles):
        for part in rows.split(max(1, chunk // (r_u * r_v))):
            index = texel_index(tiles[part], (r_u, r_v), packing.width, packing.height)
            means[part] = flat[index].mean(dim=(1, 2))
    return means


def coverage(tiles: np.ndarray, width: int, height: int, layers: int) -> np.ndarray:
    """Which 4 x 4 blocks belong to a tile: [layers, height / 4, width / 4] bool."""
    blocks = torch.from_numpy(np.ascontiguousarray(tiles)).clone()
    blocks[:, [0, 1, 3, 4]] //= 4
    mask = torch.zeros(layers * (height // 4) * (width // 4), dtype=torch.bool)
    for r_u, r_v, rows in size_classes(blocks):
        mask[texel_index(blocks[rows], (r_u, r_v), width // 4, height // 4).reshape(-1)] = True
    return mask.reshape(layers, height // 4, width // 4).numpy()
