"""How far stored tiles are from the field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy.typing as npt
import torch
from torch import Tensor

from bitymi_ns.bake.options import STEPS
from bitymi_ns.bake.pages import size_classes, texel_index
from bitymi_ns.bake.plan import Field, Plan
from bitymi_ns.bake.reference import references
from bitymi_ns.bake.resample import read_at
from bitymi_ns.bake.statistics import Percentiles, TileError
from bitymi_ns.progress import Progress, no_progress


def weighted_rms(difference: Tensor, weight: Tensor) -> Tensor:
    """Root mean square of difference [n, 3, v, u] times weight [n, v, u] where that is not 0, in 8-bit steps: [n]."""
    count = 3 * (weight > 0).flatten(1).sum(1).clamp(min=1)
    square = (difference.square().sum(1) * weight.square()).flatten(1).sum(1)
    return STEPS * (square / count).sqrt()


@dataclass
class TileErrors:
    """Errors in 8-bit steps, each times the largest blending weight that a fragment has there.

    Attributes:
        rms: [N] root mean square over the visible part of each surfel and the colour channels.
        largest: [N] largest absolute value.
        shown: [N] bool, whether any fragment of the surfel gets a residual; the errors are 0 elsewhere.
    """

    rms: Tensor
    largest: Tensor
    shown: Tensor

    def summary(self, tolerance: float) -> TileError:
        """Percentiles over the surfels that get a residual at all, and the tolerance that was asked for."""
        unit = "8-bit steps, weighted by the blending weight; stored atlas against field"
        rms, largest = (
            Percentiles.of(values[self.shown] if self.shown.any() else torch.zeros(1))
            for values in (self.rms, self.largest)
        )
        return TileError(tolerance=tolerance, unit=unit, rms=rms, largest=largest)


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
    rms, largest = torch.zeros(len(plan)), torch.zeros(len(plan))
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
        weighted = STEPS * difference.abs().amax(1) * part.weight
        largest[rows] = weighted.flatten(1).amax(1).cpu()
        done += len(rows)
        progress("measuring the error", done, len(plan))
    return TileErrors(rms, largest, plan.extent.cpu() > 0)
