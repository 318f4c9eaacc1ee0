"""Tiles of surfels: where they lie, how much an error of a texel counts, and the smallest grids within a tolerance."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache

import torch
from torch import Tensor

from bitymi_ns.bake.inputs import BakeInput
from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.codec.pages import first_texels, listed_tiles
from bitymi_ns.codec.quantise import STEPS
from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.tile_sizes import kernel_parameters

ALPHA_CONTRAST = 0.25  # of an error of alpha: how far a surfel's colour differs from that behind it, as a rule


@dataclass(frozen=True)
class Tiles:
    """Tiles of N surfels on the CPU."""

    sizes: Tensor  # [N, 2] sides (r_u, r_v), texels; (0, 0) = no tile
    extent: Tensor  # [N] half side in scale units
    # [T, C] in the order of `ops.TexelTiles`, residual colours and, where C = 4, alpha; a surfel without a tile has one
    texels: Tensor
    nonfinite: int = 0  # points at which the field was not finite


@dataclass
class TileVisibility:
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
    """Compute surfel coordinates of texel centres along one axis: (i + 0.5) / count * 2 extent - extent.

    Args:
        count: texels along the axis.
        extent: [...] half sides of tiles in scale units (e; 3 covers exactly the support), [1] or broadcast with it.

    Returns:
        [..., count] of the extents' type.
    """
    return extent * ((2.0 * torch.arange(count, device=extent.device) + 1.0) / count - 1.0)


def grid(count: tuple[int, int], extent: Tensor) -> tuple[Tensor, Tensor]:
    """Compute surfel coordinates u, v [n, count_v, count_u] of the cell centres of tiles of half sides [n]."""
    u, v = (texel_centers(c, extent[:, None]) for c in count)
    return u[:, None, :].expand(-1, count[1], -1), v[:, :, None].expand(-1, -1, count[0])


def weights(shown: TileVisibility, rows: Tensor, count: tuple[int, int]) -> Tensor:
    """Compute the largest blending weight [n, count_v, count_u] at the points of `grid`; 0 without residual."""
    u, v = grid(count, shown.extent[rows])
    rest = 1.0 - (u.square() + v.square()) / SUPPORT**2
    weight = shown.opacity[rows, None, None] * rest.clamp(min=1e-12) ** shown.beta[rows, None, None]
    return torch.where((rest > 0) & (weight >= shown.weight_bound), weight, torch.zeros_like(weight))


def weighted_rms(difference: Tensor, weight: Tensor) -> Tensor:
    """Compute the root mean square of difference [n, C, v, u] times weight [n, v, u] where not 0, 8-bit steps: [n].
    Alpha, the fourth of four channels, counts by `ALPHA_CONTRAST`."""
    count = 3 * (weight > 0).flatten(1).sum(1).clamp(min=1)
    squares = difference[:, :3].square().sum(1)
    if difference.shape[1] == 4:
        squares = squares + (ALPHA_CONTRAST * difference[:, 3]).square()
    square = (squares * weight.square()).flatten(1).sum(1)
    return STEPS * (square / count).sqrt()


def tile_values(texels: Tensor, sizes: Tensor, shown: TileVisibility, chunk: int) -> Iterator[TileValues]:
    """Yield the texels in chunks of tiles of one size.

    Args:
        texels: [T, C] in the order of `ops.TexelTiles`, on the device of `shown`.
        sizes: [N, 2] sides of the tiles there; surfels without one are left out.
        shown: N rows.
        chunk: texels taken at once (a tile is never split).
    """
    for size, rows, index in listed_tiles(sizes, chunk):
        yield TileValues(rows, size, texels[index].permute(0, 3, 1, 2).contiguous(), weights(shown, rows, size), 0)


_FORESIGHT = 1.1  # how much larger than the tolerance the predicted error of a grid may be for it to be tried


@lru_cache(maxsize=64)
def interpolation(probes: int, texels: int) -> Tensor:
    """Build the matrix [probes, texels] float32 from a tile's texels to evenly spaced probes along one axis.

    Linear between texel centres and constant beyond the outer ones, as the renderers fetch them.
    """
    x = ((torch.arange(probes, dtype=torch.float64) + 0.5) * texels / probes - 0.5).clamp(0, texels - 1)
    low = x.floor().long().clamp(max=max(texels - 2, 0))
    matrix = torch.zeros(probes, texels, dtype=torch.float64)
    rows = torch.arange(probes)
    matrix[rows, low] = 1 - (x - low)
    matrix[rows, (low + 1).clamp(max=texels - 1)] += x - low
    return matrix.float()


@lru_cache(maxsize=64)
def fit(probes: int, texels: int) -> Tensor:
    """Build the least-squares matrix [texels, probes] float32 from values at the probes to texels."""
    return torch.linalg.pinv(interpolation(probes, texels).double()).float()


def along_axes(x: Tensor, along_u: Tensor, along_v: Tensor) -> Tensor:
    """Compute along_v x along_u^T per channel: [n, C, V, U] with [u, U], [v, V] -> [n, C, v, u]."""
    y = (x @ along_u.T).transpose(2, 3)  # one product of matrices each
    return (y.contiguous() @ along_v.T).transpose(2, 3).contiguous()


def fitted(values: Tensor, size: tuple[int, int]) -> Tensor:
    """Fit tiles [n, C, v, u] on another grid (u, v), by least squares."""
    u, v = values.shape[3], values.shape[2]
    return along_axes(values, fit(u, size[0]).to(values), fit(v, size[1]).to(values))


def read_at(texels: Tensor, size: tuple[int, int]) -> Tensor:
    """Interpolate tiles [n, C, v, u] on a finer grid (u, v)."""
    u, v = texels.shape[3], texels.shape[2]
    return along_axes(texels, interpolation(size[0], u).to(texels), interpolation(size[1], v).to(texels))


@dataclass
class Reduced:
    """Chosen grids, and their texels."""

    sizes: Tensor  # [N, 2] int32 (r_u, r_v), 0 for a surfel without a tile
    constant: Tensor  # [N, C] the residual, and alpha where C = 4, of the surfels without a tile
    # (rows [n], texels [n, C, r_v, r_u]) of tiles of one size
    parts: list[tuple[Tensor, Tensor]] = field(default_factory=list)
    nonfinite: int = 0  # number of points at which the field was not finite (taken as 0 there)

    def tiles(self, shown: TileVisibility, extent: float) -> Tiles:
        """Assemble the tiles in their order; `extent` is the half side of those that show nothing."""
        first = first_texels(self.sizes)
        texels = self.constant.repeat_interleave(self.sizes.long().clamp(min=1).prod(dim=1), dim=0)
        for rows, values in self.parts:
            own = values.permute(0, 2, 3, 1).flatten(1, 2)
            texels[first[rows, None] + torch.arange(own.shape[1])] = own
        return Tiles(self.sizes, torch.where(shown.extent > 0, shown.extent, extent).cpu(), texels, self.nonfinite)


@torch.no_grad()
def reduce_tiles(
    wanted: Iterable[TileValues],
    shown: TileVisibility,
    tolerance: float,
    r_min: int = 4,
    progress: Progress = no_progress,
    channels: int = 3,
) -> Reduced:
    """Choose every tile's grid.

    The error of a grid is (reconstruction - what the tile should hold) times the largest blending weight that a
    fragment has there, in 8-bit steps: its root mean square over the colour channels and over the part of the support
    that gets a residual.
    Grids are tried by their number of texels, starting with none (one constant colour). The first within the tolerance
    is taken, the plan's limit at the latest.

    Args:
        tolerance: largest error, 8-bit steps.
        r_min: smallest side of a tile, a power of two.
        channels: C of the tiles.
    """
    n = len(shown.extent)
    reduced = Reduced(torch.zeros(n, 2, dtype=torch.int32), torch.zeros(n, channels))
    done = int((shown.extent <= 0).sum())
    for part in wanted:
        reduced.nonfinite += part.nonfinite
        constant, flat = _constant(part, tolerance)
        reduced.constant[part.rows.cpu()] = constant.cpu()
        textured = torch.nonzero(~flat).squeeze(1)
        for size, at in _grids(part, textured, tolerance, r_min):
            rows = part.rows[at].cpu()
            reduced.sizes[rows] = torch.tensor(size, dtype=torch.int32)
            texels = part.values[at] if size == part.size else fitted(part.values[at], size)
            reduced.parts.append((rows, texels.cpu()))
        done += len(part.rows)
        progress("choosing the tiles", done, n)
    return reduced


def _constant(part: TileValues, tolerance: float) -> tuple[Tensor, Tensor]:
    """Find the nearest constant [n, C], and if it is within the tolerance [n] bool."""
    square = part.weight.square()[:, None]
    constant = (part.values * square).sum((2, 3)) / square.sum((2, 3)).clamp(min=1e-12)
    return constant, weighted_rms(part.values - constant[:, :, None, None], part.weight) <= tolerance


def _grids(part: TileValues, rows: Tensor, tolerance: float, r_min: int) -> list[tuple[tuple[int, int], Tensor]]:
    """Find the smallest grid of each of `rows` (of `part`): pairs of size and rows.

    The errors of coarsening along u alone and along v alone, added in squares, predict that of both. Only grids that
    are promising by that are tried.
    """
    limit_u, limit_v = part.size
    sides_u, sides_v = ([r for r in (r_min << i for i in range(16)) if r < side] + [side] for side in part.size)
    values, weight = part.values[rows], part.weight[rows]
    along_u = {limit_u: torch.zeros(len(rows), device=rows.device)}
    along_v = {limit_v: torch.zeros(len(rows), device=rows.device)}
    for side in sides_u[:-1]:
        lost = torch.eye(limit_u) - interpolation(limit_u, side) @ fit(limit_u, side)
        along_u[side] = weighted_rms(values @ lost.T.to(values), weight).square()
    flipped = values.transpose(2, 3).contiguous()
    for side in sides_v[:-1]:
        lost = torch.eye(limit_v) - interpolation(limit_v, side) @ fit(limit_v, side)
        along_v[side] = weighted_rms((flipped @ lost.T.to(values)).transpose(2, 3), weight).square()
    found = []
    open_ = torch.ones(len(rows), dtype=torch.bool, device=rows.device)
    for size in sorted(((u, v) for u in sides_u for v in sides_v), key=lambda s: (s[0] * s[1], abs(s[0] - s[1]))):
        promising = open_ & (along_u[size[0]] + along_v[size[1]] <= (_FORESIGHT * tolerance) ** 2)
        at = torch.nonzero(promising).squeeze(1)
        if size != part.size and len(at):
            rebuilt = read_at(fitted(values[at], size), part.size)
            at = at[weighted_rms(rebuilt - values[at], weight[at]) <= tolerance]
        if len(at):
            open_[at] = False
            found.append((size, rows[at]))
    return found


def reduced_tiles(tiles: Tiles, inputs: BakeInput, options: BakeOptions, progress: Progress) -> Tiles:
    """Resample every tile to the smallest grid within the tolerance; no tile where one colour is.

    Args:
        inputs: the surfels, and what the views see of them; their device does the work.
    """
    opacity, beta = kernel_parameters(inputs.surfels, inputs.transmittance)
    device, channels = opacity.device, tiles.texels.shape[1]
    shown = TileVisibility(opacity, beta, tiles.extent.to(device), inputs.weight_bound)
    parts = tile_values(tiles.texels.to(device), tiles.sizes.to(device), shown, options.chunk)
    smaller = reduce_tiles(parts, shown, options.tolerance, options.r_min, progress, channels)
    bare = tiles.sizes[:, 0] == 0
    smaller.constant[bare] = tiles.texels[first_texels(tiles.sizes)[bare]]
    return smaller.tiles(shown, options.extent)
