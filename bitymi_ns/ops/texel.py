"""Texels of surfels in one list, and their step in a backward pass."""

from __future__ import annotations

import functools
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor


@dataclass(frozen=True)
class TexelTiles:
    """The surfels' tiles in a texel list [T, 3].

    Texel (i, j) of surfel s, i along u and j along v, is row first[s] + j r_u + i; its centre lies at
    u = (i + 0.5) / r_u * 2e - e, v likewise. A tile of 1 x 1 texel is a constant.
    """

    first: Tensor  # [N] int64
    size: Tensor  # [N, 2] int32 (r_u, r_v); (0, 0): no tile
    extent: Tensor  # [N] half side e of the tile in scale units, of the texels' dtype

    @classmethod
    def of_sizes(cls, size: Tensor, extent: Tensor) -> TexelTiles:
        """Lay out tiles of sizes [N, 2] and extents [N] consecutively."""
        area = size.long().prod(dim=1)
        return cls(area.cumsum(0) - area, size.to(torch.int32).contiguous(), extent.contiguous())

    def rows_of(self, surfels: Tensor) -> Tensor:
        """List the texel rows [t] int64 of surfels [n], tile after tile."""
        area = self.size[surfels].long().prod(dim=1)
        shift = self.first[surfels] - (area.cumsum(0) - area)
        return shift.repeat_interleave(area) + torch.arange(int(area.sum()), device=area.device)

    @property
    def arrays(self) -> dict[str, Tensor]:
        """The kernels' arguments, by name."""
        return {"first": self.first, "size": self.size, "extent": self.extent}

    @functools.cached_property
    def count(self) -> int:
        """Texels of all tiles; read from the device once."""
        return int(self.size.long().prod(dim=1).sum())


@dataclass(frozen=True)
class TexelAlpha:
    """Opacity factors by texel: sigma = min(0.99, sigma0 m) for fragments whose weight sigma0 T would be at least
    `bound`, with m the bilinear fetch at (u, v). Fragments with sigma0 < 1/255 are skipped for any m."""

    tiles: TexelTiles
    values: Tensor  # [T] m, from 0 to 2
    bound: float

    def of(self, surfels: Tensor) -> TexelAlpha:
        """Select the texels of surfels [n] int64."""
        tiles = TexelTiles.of_sizes(self.tiles.size[surfels], self.tiles.extent[surfels])
        return TexelAlpha(tiles, self.values[self.tiles.rows_of(surfels)], self.bound)

    def to(self, device: torch.device | str) -> TexelAlpha:
        tiles = TexelTiles(*(t.to(device) for t in (self.tiles.first, self.tiles.size, self.tiles.extent)))
        return TexelAlpha(tiles, self.values.to(device), self.bound)

    @property
    def arrays(self) -> dict[str, Any]:
        """The kernels' arguments, by name."""
        return {**self.tiles.arrays, "texel_alpha": self.values.detach(), "alpha_bound": self.bound}


@dataclass(frozen=True)
class TexelDescent:
    """Texel step of a backward pass: texel t moves by -rate share[t] times its gradient."""

    share: Tensor  # [T] of the texels' dtype
    rate: float
    moved: Tensor | None = None  # [T, 3] texels to update; None: those that are read

    def arguments(self, read: Tensor) -> dict[str, Any]:
        """The kernels' arguments for a backward pass that reads texels `read`."""
        return {"moved": read if self.moved is None else self.moved, "share": self.share, "rate": self.rate}


def gradient_or_step(
    texels: Tensor, learns: bool, descent: TexelDescent | None
) -> tuple[Tensor | None, dict[str, Any]]:
    """Prepare the backward pass of texels [T, 3]: a zero gradient [T, 3] to fill, None unless they learn, and the
    kernels' arguments."""
    if not learns:
        return None, {"rate": 0.0} if descent is None else descent.arguments(texels)
    dtexels = torch.zeros_like(texels)
    # a gradient is a step of length -1 from 0
    return dtexels, TexelDescent(texels.new_ones(len(texels)), -1.0, dtexels).arguments(texels)
