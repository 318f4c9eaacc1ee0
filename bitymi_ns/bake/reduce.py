"""Smallest grids of tiles within a tolerance, and resampling of tiles as matrices along their axes."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from functools import lru_cache

import torch
from torch import Tensor

from bitymi_ns.bake.inputs import BakeInput
from bitymi_ns.bake.tile_errors import weighted_rms
from bitymi_ns.bake.tiles import Shown, Tiles, TileValues, tile_values
from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.codec.pages import first_texels
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.tile_sizes import kernel_parameters

_FORESIGHT = 1.1  # how much larger than the tolerance the predicted error of a grid may be for it to be tried


@lru_cache(maxsize=64)
def interpolation(probes: int, texels: int) -> Tensor:
    """Values at evenly spaced probes (cell centres) from a tile's texels along one axis: [probes, texels] float32.

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
    """[texels, probes] float32: the texels whose interpolation is nearest to values at the probes, least squares."""
    return torch.linalg.pinv(interpolation(probes, texels).double()).float()


def along_axes(x: Tensor, along_u: Tensor, along_v: Tensor) -> Tensor:
    """along_v x along_u^T of every channel: [n, C, V, U] with [u, U], [v, V] -> [n, C, v, u]."""
    y = (x @ along_u.T).transpose(2, 3)  # one product of matrices each
    return (y.contiguous() @ along_v.T).transpose(2, 3).contiguous()


def fitted(values: Tensor, size: tuple[int, int]) -> Tensor:
    """Tiles [n, C, v, u] on another grid (u, v), by least squares."""
    u, v = values.shape[3], values.shape[2]
    return along_axes(values, fit(u, size[0]).to(values), fit(v, size[1]).to(values))


def read_at(texels: Tensor, size: tuple[int, int]) -> Tensor:
    """Interpolate tiles [n, C, v, u] on a finer grid (u, v)."""
    u, v = texels.shape[3], texels.shape[2]
    return along_axes(texels, interpolation(size[0], u).to(texels), interpolation(size[1], v).to(texels))


@dataclass
class Reduced:
    """The grids that were chosen, and their texels."""

    sizes: Tensor  # [N, 2] int32 (r_u, r_v), 0 for a surfel without a tile
    constant: Tensor  # [N, C] the residual, and alpha where C = 4, of the surfels without a tile
    # (rows [n], texels [n, C, r_v, r_u]) of tiles of one size
    parts: list[tuple[Tensor, Tensor]] = field(default_factory=list)
    nonfinite: int = 0  # number of points at which the field was not finite (taken as 0 there)

    def tiles(self, shown: Shown, extent: float) -> Tiles:
        """The tiles, in their list; those of which nothing is shown have a half side `extent`."""
        first = first_texels(self.sizes)
        texels = self.constant.repeat_interleave(self.sizes.long().clamp(min=1).prod(dim=1), dim=0)
        for rows, values in self.parts:
            own = values.permute(0, 2, 3, 1).flatten(1, 2)
            texels[first[rows, None] + torch.arange(own.shape[1])] = own
        return Tiles(self.sizes, torch.where(shown.extent > 0, shown.extent, extent).cpu(), texels, self.nonfinite)


@torch.no_grad()
def reduce_tiles(
    wanted: Iterable[TileValues],
    shown: Shown,
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
    """The constant nearest to the tile, [n, C], and whether it is near enough, [n] bool."""
    square = part.weight.square()[:, None]
    constant = (part.values * square).sum((2, 3)) / square.sum((2, 3)).clamp(min=1e-12)
    return constant, weighted_rms(part.values - constant[:, :, None, None], part.weight) <= tolerance


def _grids(part: TileValues, rows: Tensor, tolerance: float, r_min: int) -> list[tuple[tuple[int, int], Tensor]]:
    """The smallest grid of each of `rows` (of `part`): pairs of size and rows.

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
    shown = Shown(opacity, beta, tiles.extent.to(device), inputs.weight_bound)
    parts = tile_values(tiles.texels.to(device), tiles.sizes.to(device), shown, options.chunk)
    smaller = reduce_tiles(parts, shown, options.tolerance, options.r_min, progress, channels)
    bare = tiles.sizes[:, 0] == 0
    smaller.constant[bare] = tiles.texels[first_texels(tiles.sizes)[bare]]
    return smaller.tiles(shown, options.extent)
