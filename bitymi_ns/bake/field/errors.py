"""Errors of stored tiles against the field."""

from dataclasses import dataclass

import torch
from torch import Tensor

from bitymi_ns.bake.field.plan import Field, Plan, references
from bitymi_ns.bake.tile_errors import cells_per_pixel, seen_rms, weighted_rms
from bitymi_ns.bake.tiles import read_at
from bitymi_ns.bundle.statistics import Certificate, Percentiles, TileError
from bitymi_ns.codec.pages import first_texels, size_classes
from bitymi_ns.codec.quantise import STEPS
from bitymi_ns.progress import Progress, no_progress


@dataclass
class TileErrors:
    """Errors in 8-bit steps, each times the largest blending weight that a fragment has there."""

    rms: Tensor  # [N] root mean square over the visible part of each surfel and the colour channels
    largest: Tensor  # [N] largest absolute value
    seen: Tensor  # [N] root mean square of what the closest training view sees, which averages over its pixels
    shown: Tensor  # [N] bool, whether any fragment of the surfel gets a residual; the errors are 0 elsewhere

    def summary(self, tolerance: float) -> TileError:
        """Compute percentiles over the surfels with a residual."""
        unit = "8-bit steps, weighted by the blending weight; stored atlas against field"
        rms, largest = (
            Percentiles.of(values[self.shown] if self.shown.any() else torch.zeros(1))
            for values in (self.rms, self.largest)
        )
        return TileError(tolerance=tolerance, unit=unit, rms=rms, largest=largest)

    def certificate(self, tolerance: float) -> Certificate | None:
        """Certify these surfels; None without a tolerance."""
        return Certificate.of(self.seen[self.shown], tolerance, "field") if tolerance else None


@torch.no_grad()
def tile_errors(
    field: Field,
    plan: Plan,
    sizes: Tensor,
    texels: Tensor,
    chunk: int = 1 << 18,
    progress: Progress = no_progress,
) -> TileErrors:
    """Compare stored tiles with the field on the grids of the plan.

    Args:
        plan: what the tiles have to hold; its extents must be those of the tiles.
        sizes: [N, 2] sides of the tiles.
        texels: [T, 3] as a renderer reads them, in the order of `ops.TexelTiles`.
        chunk: points evaluated at once.
    """
    rms, largest, seen = (torch.zeros(len(plan)) for _ in range(3))
    first, done = first_texels(sizes), 0
    for part in references(field, plan, chunk):
        rows = part.rows.cpu()
        rebuilt = texels[first[rows]][:, :, None, None].expand(part.values.shape).clone()
        for r_u, r_v, at in size_classes(sizes[rows]):
            index = first[rows[at], None, None] + torch.arange(r_u * r_v).view(r_v, r_u)
            rebuilt[at] = read_at(texels[index].permute(0, 3, 1, 2).contiguous(), part.size)
        difference = rebuilt.to(part.values) - part.values
        rms[rows] = weighted_rms(difference, part.weight).cpu()
        seen[rows] = seen_rms(difference, part.weight, cells_per_pixel(plan, part.rows, part.size)).cpu()
        weighted = STEPS * difference.abs().amax(1) * part.weight
        largest[rows] = weighted.flatten(1).amax(1).cpu()
        done += len(rows)
        progress("measuring the error", done, len(plan))
    return TileErrors(rms, largest, seen, plan.extent.cpu() > 0)
