"""How far stored tiles are from the field, or from what they held before."""

from __future__ import annotations

from dataclasses import dataclass

import numpy.typing as npt
import torch
from torch import Tensor

from bitymi_ns.bake.field.footprint import averaged, cells_per_pixel
from bitymi_ns.bake.field.plan import Field, Plan, Shown
from bitymi_ns.bake.field.reference import references, weights
from bitymi_ns.bake.resample import read_at
from bitymi_ns.bundle.statistics import Certificate, Percentiles, TileError
from bitymi_ns.codec.pages import size_classes, texel_index
from bitymi_ns.codec.quantise import STEPS
from bitymi_ns.ops import TexelTiles
from bitymi_ns.progress import Progress, no_progress

_CONSTANT = (8, 8)
"""Points at which the weight of a surfel without a tile is looked at."""


def weighted_rms(difference: Tensor, weight: Tensor) -> Tensor:
    """Root mean square of difference [n, 3, v, u] times weight [n, v, u] where that is not 0, in 8-bit steps: [n]."""
    count = 3 * (weight > 0).flatten(1).sum(1).clamp(min=1)
    square = (difference.square().sum(1) * weight.square()).flatten(1).sum(1)
    return STEPS * (square / count).sqrt()


def seen_rms(difference: Tensor, weight: Tensor, cells: Tensor) -> Tensor:
    """`weighted_rms` of what a view can see: difference times weight is averaged over its pixels first, of `cells`
    [n, 2]."""
    return weighted_rms(averaged(difference * weight[:, None], cells), (weight > 0).float())


@torch.no_grad()
def listed_errors(difference: Tensor, sizes: Tensor, shown: Shown, chunk: int = 1 << 18) -> tuple[Tensor, Tensor]:
    """What differences of texels are as the closest training view sees them.

    Args:
        difference: [T, 3] in the order of `ops.TexelTiles`: a surfel without a tile has one.
        sizes: [N, 2] sides of the tiles; (0, 0) = none.
        shown: how much of the tiles is seen, N rows.
        chunk: texels taken at once (a tile is never split).

    Returns:
        [N] root mean squares in 8-bit steps, each times the largest blending weight that a fragment has there; and [N]
        bool, whether any fragment of the surfel gets a residual.
    """
    errors, seen = torch.zeros(len(sizes)), torch.zeros(len(sizes), dtype=torch.bool)
    first = TexelTiles.of_sizes(sizes.clamp(min=1), shown.extent).first
    bare = torch.nonzero(sizes[:, 0] == 0).squeeze(1)
    classes = size_classes(torch.cat([sizes.new_zeros(len(sizes), 3), sizes], dim=1))
    for r_u, r_v, members in [*classes, (*_CONSTANT, bare)]:
        for rows in members.split(max(1, chunk // (r_u * r_v))):
            inside = torch.arange(r_u * r_v) if members is not bare else torch.zeros(r_u * r_v, dtype=torch.long)
            values = difference[first[rows, None] + inside].view(-1, r_v, r_u, 3).permute(0, 3, 1, 2)
            weight, extent = weights(shown, rows, (r_u, r_v)), shown.extent[rows]
            pixels = None if shown.pixels is None else shown.pixels[rows]
            errors[rows] = seen_rms(values, weight, cells_per_pixel(pixels, extent, (r_u, r_v)))
            seen[rows] = (weight > 0).flatten(1).any(1)
    return errors, seen


@dataclass
class TileErrors:
    """Errors in 8-bit steps, each times the largest blending weight that a fragment has there.

    Attributes:
        rms: [N] root mean square over the visible part of each surfel and the colour channels.
        largest: [N] largest absolute value.
        seen: [N] root mean square of what the closest training view sees, which averages over its pixels.
        shown: [N] bool, whether any fragment of the surfel gets a residual; the errors are 0 elsewhere.
    """

    rms: Tensor
    largest: Tensor
    seen: Tensor
    shown: Tensor

    def summary(self, tolerance: float) -> TileError:
        """Percentiles over the surfels that get a residual at all, and the tolerance that was asked for."""
        unit = "8-bit steps, weighted by the blending weight; stored atlas against field"
        rms, largest = (
            Percentiles.of(values[self.shown] if self.shown.any() else torch.zeros(1))
            for values in (self.rms, self.largest)
        )
        return TileError(tolerance=tolerance, unit=unit, rms=rms, largest=largest)

    def certificate(self, tolerance: float) -> Certificate | None:
        """How many of these surfels are within the tolerance as they are seen; None without one."""
        return Certificate.of(self.seen[self.shown], tolerance, "field") if tolerance else None


@torch.no_grad()
def tile_errors(
    field: Field,
    plan: Plan,
    tiles: npt.NDArray,
    mean_residual: Tensor,
    residuals: npt.NDArray | None,
    chunk: int = 1 << 18,
    progress: Progress = no_progress,
) -> TileErrors:
    """Compares stored tiles with the field on the grids of the plan.

    Args:
        field: the residual field.
        plan: what the tiles have to hold; its extents must be those of the tiles.
        tiles: [N, 5] int32.
        mean_residual: [N, 3] the residual of the surfels without a tile.
        residuals: [layers, height, width, 3] the atlas as a renderer reads it, None without tiles.
        chunk: points evaluated at once.
        progress: called with the number of tiles done.
    """
    rms, largest, seen = (torch.zeros(len(plan)) for _ in range(3))
    places = torch.as_tensor(tiles)
    flat = None if residuals is None else torch.as_tensor(residuals).reshape(-1, 3)
    done = 0
    for part in references(field, plan, chunk):
        rows = part.rows.cpu()
        rebuilt = mean_residual[rows][:, :, None, None].expand(part.values.shape).clone()
        if flat is not None:
            for r_u, r_v, at in size_classes(places[rows]):
                index = texel_index(places[rows[at]], (r_u, r_v), residuals.shape[2], residuals.shape[1])
                stored = flat[index].permute(0, 3, 1, 2).contiguous()
                rebuilt[at] = read_at(stored, part.size)
        difference = rebuilt.to(part.values) - part.values
        rms[rows] = weighted_rms(difference, part.weight).cpu()
        pixels = None if plan.pixels is None else plan.pixels[part.rows]
        cells = cells_per_pixel(pixels, plan.extent[part.rows], part.size)
        seen[rows] = seen_rms(difference, part.weight, cells).cpu()
        weighted = STEPS * difference.abs().amax(1) * part.weight
        largest[rows] = weighted.flatten(1).amax(1).cpu()
        done += len(rows)
        progress("measuring the error", done, len(plan))
    return TileErrors(rms, largest, seen, plan.extent.cpu() > 0)
