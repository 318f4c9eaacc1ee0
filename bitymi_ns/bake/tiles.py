"""Tiles of surfels: where they lie, the texels that they hold, and how much an error of a texel counts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import torch
from torch import Tensor

from bitymi_ns.codec.pages import listed_tiles
from bitymi_ns.ops.constants import SUPPORT


@dataclass(frozen=True)
class Tiles:
    """Tiles of N surfels on the CPU."""

    sizes: Tensor  # [N, 2] sides (r_u, r_v), texels; (0, 0) = no tile
    extent: Tensor  # [N] half side in scale units
    # [T, C] in the order of `ops.TexelTiles`, residual colours and, where C = 4, alpha; a surfel without a tile has one
    texels: Tensor
    nonfinite: int = 0  # points at which the field was not finite


@dataclass
class Shown:
    """Largest visible part and weight of N tiles."""

    opacity: Tensor  # [N] largest blending weight of the surfel's centre
    beta: Tensor  # [N] exponent of the kernel
    # [N] half side of the tile in scale units, beyond which every fragment is below the weight bound; 0 where all are
    extent: Tensor
    weight_bound: float  # fragments of smaller weight get no residual
    # [N, 2] pixels per scale unit in the closest view (`tile_errors.closest_pixels`); None = not known
    pixels: Tensor | None = field(default=None, kw_only=True)


@dataclass
class TileValues:
    """Target texels of n tiles of one size."""

    rows: Tensor  # [n] int64 rows of the surfels
    size: tuple[int, int]  # (u, v) texels
    values: Tensor  # [n, C, v, u] residual colours, and alpha where C = 4
    weight: Tensor  # [n, v, u] weight of an error
    nonfinite: int  # points at which the field was not finite


def texel_centers(count: int, extent: Tensor) -> Tensor:
    """Surfel coordinates of texel centres along one axis: (i + 0.5) / count * 2 extent - extent.

    Args:
        count: texels along the axis.
        extent: [...] half sides of tiles in scale units (e; 3 covers exactly the support), [1] or broadcast with it.

    Returns:
        [..., count] of the extents' type.
    """
    return extent * ((2.0 * torch.arange(count, device=extent.device) + 1.0) / count - 1.0)


def grid(count: tuple[int, int], extent: Tensor) -> tuple[Tensor, Tensor]:
    """Surfel coordinates u, v [n, count_v, count_u] of the cell centres of tiles of half sides [n]."""
    u, v = (texel_centers(c, extent[:, None]) for c in count)
    return u[:, None, :].expand(-1, count[1], -1), v[:, :, None].expand(-1, -1, count[0])


def weights(shown: Shown, rows: Tensor, count: tuple[int, int]) -> Tensor:
    """[n, count_v, count_u] largest blending weight of a fragment at the points of `grid`; 0 without residual."""
    u, v = grid(count, shown.extent[rows])
    rest = 1.0 - (u.square() + v.square()) / SUPPORT**2
    weight = shown.opacity[rows, None, None] * rest.clamp(min=1e-12) ** shown.beta[rows, None, None]
    return torch.where((rest > 0) & (weight >= shown.weight_bound), weight, torch.zeros_like(weight))


def tile_values(texels: Tensor, sizes: Tensor, shown: Shown, chunk: int) -> Iterator[TileValues]:
    """Texels of the tiles, in chunks of tiles of one size.

    Args:
        texels: [T, C] in the order of `ops.TexelTiles`, on the device of `shown`.
        sizes: [N, 2] sides of the tiles there; surfels without one are left out.
        shown: N rows.
        chunk: texels taken at once (a tile is never split).
    """
    for size, rows, index in listed_tiles(sizes, chunk):
        yield TileValues(rows, size, texels[index].permute(0, 3, 1, 2).contiguous(), weights(shown, rows, size), 0)
