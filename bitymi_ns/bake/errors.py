"""How far stored tiles are from the field."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy.typing as npt
import torch
from torch import Tensor

from bitymi_ns.bake.evaluate import size_classes, texel_index
from bitymi_ns.bake.plan import STEPS, Field, Plan, along_axes, interpolation, references, weighted_rms
from bitymi_ns.progress import Progress, no_progress


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

    def summary(self) -> dict[str, Any]:
        """Percentiles over the surfels that get a residual at all, for bundle.json."""
        result: dict[str, Any] = {"unit": "8-bit steps, weighted by the blending weight; stored atlas against field"}
        for name, values in (("rms", self.rms), ("largest", self.largest)):
            values = values[self.shown].double().sort().values if self.shown.any() else torch.zeros(1)
            for percent in (50, 90, 99, 100):
                at = round((len(values) - 1) * percent / 100)
                result.setdefault(name, {})[f"p{percent}"] = round(float(values[at]), 4)
        return result


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
                rebuilt[at] = along_axes(stored, interpolation(part.size[0], r_u), interpolation(part.size[1], r_v))
        difference = rebuilt.to(part.values) - part.values
        rms[rows] = weighted_rms(difference, part.weight).cpu()
        weighted = STEPS * difference.abs().amax(1) * part.weight
        largest[rows] = weighted.flatten(1).amax(1).cpu()
        done += len(rows)
        progress("measuring the error", done, len(plan))
    return TileErrors(rms, largest, plan.extent.cpu() > 0)
