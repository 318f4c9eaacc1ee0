"""The residual field at the texel centres of every tile: the paper's bake."""

from collections.abc import Callable

import torch
from torch import Tensor

from bitymi_ns.bake.tiles import texel_centers
from bitymi_ns.codec.packing import Packing
from bitymi_ns.codec.pages import size_classes, texel_index
from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.train.init import tangents


def tile_points(means: Tensor, axes: Tensor, size: tuple[int, int], extent: float) -> Tensor:
    """World positions of the texel centres of tiles that share one size: mean + u s_u R[:,0] + v s_v R[:,1].

    Args:
        means: [N, 3] world positions.
        axes: [N, 3, 2] tangent directions times the scales, world units.
        size: (r_u, r_v) texels along u and v.
        extent: half side of the tile in scale units.

    Returns:
        [N, r_v, r_u, 3] world positions; rows run along v.
    """
    u, v = (texel_centers(count, means.new_tensor([extent])) for count in size)  # [r_u], [r_v]
    across = u[:, None] * axes[:, None, :, 0]  # [N, r_u, 3]
    down = v[:, None] * axes[:, None, :, 1]  # [N, r_v, 3]
    return means[:, None, None, :] + across[:, None, :, :] + down[:, :, None, :]


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

    Returns:
        texels: [layers, height, width, 3] float32 on the CPU; 0 (no residual) outside the tiles and where the field
            is not finite.
        nonfinite: number of texels whose value was not finite.
    """
    axes = tangents(quats) * scales[:, None, :]  # [N, 3, 2]
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
