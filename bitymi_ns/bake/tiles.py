"""Tiles of surfels: coordinates and weights of texels, and the smallest grids within a tolerance."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import torch
from torch import Tensor

from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.codec.pages import first_texels, listed_tiles
from bitymi_ns.codec.quantise import STEPS
from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.tile_sizes import kernel_parameters
from .inputs import BakeInput

ALPHA_CONTRAST = 0.25  # weight of an error of alpha: typical difference between a surfel's colour and that behind it


@dataclass(frozen=True)
class Tiles:
    """Tiles of N surfels on the CPU."""

    sizes: Tensor  # [N, 2] sides (r_u, r_v), texels; (0, 0) = no tile
    extent: Tensor  # [N] half side, scale units
    texels: Tensor  # [T, C], as of `Stage`


@dataclass
class TileVisibility:
    """Largest visible part and weight of N tiles."""

    opacity: Tensor  # [N] largest blending weight
    beta: Tensor  # [N] exponent of the kernel
    extent: Tensor  # [N] half side of the tile, scale units
    weight_bound: float  # fragments of smaller weight get no residual
    # [N, 2] pixels per scale unit in the closest view (`tile_errors.closest_pixels`); None = not known
    pixels: Tensor | None = field(default=None, kw_only=True)


def texel_centers(count: int, extent: Tensor) -> Tensor:
    """Compute coordinates [..., count] of the centres of `count` texels along one axis, (i + 0.5) / count * 2 extent -
    extent, scale units; half sides `extent`: [..., 1]."""
    return extent * ((2.0 * torch.arange(count, device=extent.device) + 1.0) / count - 1.0)


def grid(count: tuple[int, int], extent: Tensor) -> tuple[Tensor, Tensor]:
    """Compute coordinates u, v [n, count_v, count_u] of the cell centres of tiles of half sides [n]."""
    u, v = (texel_centers(c, extent[:, None]) for c in count)
    return u[:, None, :].expand(-1, count[1], -1), v[:, :, None].expand(-1, -1, count[0])


def weights(shown: TileVisibility, rows: Tensor, count: tuple[int, int]) -> Tensor:
    """Compute the largest blending weight [n, count_v, count_u] at the points of `grid`; 0 below the weight bound."""
    u, v = grid(count, shown.extent[rows])
    rest = 1.0 - (u.square() + v.square()) / SUPPORT**2
    weight = shown.opacity[rows, None, None] * rest.clamp(min=1e-12) ** shown.beta[rows, None, None]
    return torch.where((rest > 0) & (weight >= shown.weight_bound), weight, torch.zeros_like(weight))


def weighted_rms(difference: Tensor, weight: Tensor) -> Tensor:
    """Compute the root mean square [n], 8-bit steps, of difference [n, C, v, u] times weight [n, v, u], over texels of
    weight above 0; alpha is scaled by `ALPHA_CONTRAST`."""
    count = 3 * (weight > 0).flatten(1).sum(1).clamp(min=1)
    squares = difference[:, :3].square().sum(1)
    if difference.shape[1] == 4:
        squares = squares + (ALPHA_CONTRAST * difference[:, 3]).square()
    square = (squares * weight.square()).flatten(1).sum(1)
    return STEPS * (square / count).sqrt()


_FORESIGHT = 1.1  # largest predicted error of a grid that is tried, relative to the tolerance


@lru_cache(maxsize=64)
def interpolation(probes: int, texels: int) -> Tensor:
    """Build the matrix [probes, texels] float32 from texels to evenly spaced probes along one axis: linear between
    texel centres and constant beyond, as the renderers fetch them."""
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


@torch.no_grad()
def reduced_tiles(tiles: Tiles, inputs: BakeInput, options: BakeOptions, progress: Progress = no_progress) -> Tiles:
    """Resample every tile to the smallest grid within the tolerance, or to no tile where one colour is within it, by
    the error of the reconstruction (`weighted_rms`), on the device of `inputs`."""
    opacity, beta = kernel_parameters(inputs.surfels, inputs.transmittance)
    device, parts, done = opacity.device, [], 0
    shown = TileVisibility(opacity, beta, tiles.extent.to(device), inputs.weight_bound)
    fine = tiles.texels.to(device)
    constant = tiles.texels[first_texels(tiles.sizes)]
    sizes = torch.zeros(len(tiles.sizes), 2, dtype=torch.int32)
    for size, rows, index in listed_tiles(tiles.sizes.to(device), options.chunk):
        values = fine[index].permute(0, 3, 1, 2).contiguous()
        weight = weights(shown, rows, size)
        square = weight.square()[:, None]
        mean = (values * square).sum((2, 3)) / square.sum((2, 3)).clamp(min=1e-12)  # the nearest constant
        flat = weighted_rms(values - mean[:, :, None, None], weight) <= options.tolerance
        constant[rows.cpu()] = mean.cpu()
        textured = torch.nonzero(~flat).squeeze(1)
        for smaller, chosen in _grids(values[textured], weight[textured], options.tolerance, options.r_min):
            chosen = textured[chosen]
            texels = values[chosen] if smaller == size else fitted(values[chosen], smaller)
            sizes[rows[chosen].cpu()] = torch.tensor(smaller, dtype=torch.int32)
            parts.append((rows[chosen].cpu(), texels.cpu()))
        done += len(rows)
        progress("choosing the tiles", done, len(sizes))
    first = first_texels(sizes)
    listed = constant.repeat_interleave(sizes.long().clamp(min=1).prod(dim=1), dim=0)
    for rows, texels in parts:
        own = texels.permute(0, 2, 3, 1).flatten(1, 2)
        listed[first[rows, None] + torch.arange(own.shape[1])] = own
    return Tiles(sizes, tiles.extent, listed)


def _grids(values: Tensor, weight: Tensor, tolerance: float, r_min: int) -> list[tuple[tuple[int, int], Tensor]]:
    """Find the smallest grid within the tolerance for each tile [n, C, v, u]: pairs of size and rows. The errors of
    coarsening along u alone and along v alone, summed in squares, predict that of both (`_FORESIGHT`)."""
    count, limit_v, limit_u = len(values), *values.shape[2:]
    limits = (limit_u, limit_v)
    sides_u, sides_v = ([r for r in (r_min << i for i in range(16)) if r < side] + [side] for side in limits)
    along_u = {limit_u: torch.zeros(count, device=values.device)}
    along_v = {limit_v: torch.zeros(count, device=values.device)}
    for side in sides_u[:-1]:
        lost = torch.eye(limit_u) - interpolation(limit_u, side) @ fit(limit_u, side)
        along_u[side] = weighted_rms(values @ lost.T.to(values), weight).square()
    flipped = values.transpose(2, 3).contiguous()
    for side in sides_v[:-1]:
        lost = torch.eye(limit_v) - interpolation(limit_v, side) @ fit(limit_v, side)
        along_v[side] = weighted_rms((flipped @ lost.T.to(values)).transpose(2, 3), weight).square()
    chosen = []
    open_ = torch.ones(count, dtype=torch.bool, device=values.device)
    for size in sorted(((u, v) for u in sides_u for v in sides_v), key=lambda s: (s[0] * s[1], abs(s[0] - s[1]))):
        promising = open_ & (along_u[size[0]] + along_v[size[1]] <= (_FORESIGHT * tolerance) ** 2)
        rows = torch.nonzero(promising).squeeze(1)
        if size != limits and len(rows):
            finer = (interpolation(limit, side).to(values) for limit, side in zip(limits, size, strict=True))
            rebuilt = along_axes(fitted(values[rows], size), *finer)
            rows = rows[weighted_rms(rebuilt - values[rows], weight[rows]) <= tolerance]
        if len(rows):
            open_[rows] = False
            chosen.append((size, rows))
    return chosen
