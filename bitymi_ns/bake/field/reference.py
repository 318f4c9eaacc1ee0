"""What tiles should hold: the residual field on the grids of a plan, or what they hold already; and how much an error
counts there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from bitymi_ns.bake.field.plan import Field, Plan, Shown
from bitymi_ns.bake.field.texels import texel_centres
from bitymi_ns.bake.resample import fitted
from bitymi_ns.codec.packing import Packing
from bitymi_ns.codec.pages import size_classes, texel_index
from bitymi_ns.ops.constants import SUPPORT


def grid(count: tuple[int, int], extent: Tensor) -> tuple[Tensor, Tensor]:
    """Surfel coordinates of evenly spaced points (cell centres) of the tiles: u, v [n, count_v, count_u]."""
    u, v = (texel_centres(c, extent[:, None]) for c in count)
    return u[:, None, :].expand(-1, count[1], -1), v[:, :, None].expand(-1, -1, count[0])


def weights(shown: Shown, rows: Tensor, count: tuple[int, int]) -> Tensor:
    """Largest blending weight of a fragment at the points of `grid`: [n, count_v, count_u]; 0 without residual."""
    u, v = grid(count, shown.extent[rows])
    rest = 1.0 - (u.square() + v.square()) / SUPPORT**2
    weight = shown.opacity[rows, None, None] * rest.clamp(min=1e-12) ** shown.beta[rows, None, None]
    return torch.where((rest > 0) & (weight >= shown.weight_bound), weight, torch.zeros_like(weight))


@dataclass
class Reference:
    """What tiles of one size should hold.

    Attributes:
        rows: [n] int64 rows of the plan.
        size: (u, v) texels, the limit of these rows.
        values: [n, 3, v, u] the field, fitted on the grid of the limit.
        weight: [n, v, u] what an error counts there.
        nonfinite: number of probes at which the field was not finite.
    """

    rows: Tensor
    size: tuple[int, int]
    values: Tensor
    weight: Tensor
    nonfinite: int


@torch.no_grad()
def references(field: Field, plan: Plan, chunk: int = 1 << 18) -> Iterator[Reference]:
    """The exact field on the grids of the plan, in chunks of tiles of one size.

    The field is evaluated at the probes and fitted by least squares on the finest useful grid. With as many probes as
    texels the result is the field's values at the texel centres. With more probes, detail that no view resolves is
    averaged out instead of aliased. Beyond the disc of radius `extent` nothing is seen. There the field is read at the
    nearest point of the disc, so values stay smooth and within the range of what is seen.

    Args:
        field: the residual field.
        plan: N tiles; those of extent 0 are left out.
        chunk: probes evaluated at once (a tile is never split).
    """
    classes, inverse = torch.unique(torch.cat([plan.probes, plan.limit], dim=1), dim=0, return_inverse=True)
    for i, (pu, pv, lu, lv) in enumerate(classes.tolist()):
        members = torch.nonzero((inverse == i) & (plan.extent > 0)).squeeze(1)
        for rows in members.split(max(1, chunk // (pu * pv))):
            if len(rows) == 0:
                continue
            extent = plan.extent[rows]
            u, v = grid((pu, pv), extent)
            inward = (extent[:, None, None] / torch.hypot(u, v).clamp(min=1e-12)).clamp(max=1.0)
            uv = torch.stack([u * inward, v * inward], dim=-1).flatten(1, 2)  # [n, pv pu, 2]
            x = plan.means[rows, None] + uv @ plan.edges[rows].transpose(1, 2)  # [n, pv pu, 3]
            value = field(x.reshape(-1, 3)).float()
            bad = ~torch.isfinite(value).all(dim=1)
            if bad.any():
                value = value.masked_fill(bad[:, None], 0.0)
            values = value.reshape(len(rows), pv, pu, 3).permute(0, 3, 1, 2).contiguous()
            if (pu, pv) != (lu, lv):
                values = fitted(values, (lu, lv))
            yield Reference(rows, (lu, lv), values, weights(plan, rows, (lu, lv)), int(bad.sum()))


@torch.no_grad()
def held(texels: Tensor, packing: Packing, shown: Shown, chunk: int = 1 << 18) -> Iterator[Reference]:
    """What tiles hold, in chunks of tiles of one size.

    Args:
        texels: [layers, height, width, 3] in the places of `packing`, on the device of `shown`.
        packing: N tiles; surfels without one are left out.
        shown: how much of them is.
        chunk: texels taken at once (a tile is never split).
    """
    tiles, flat = torch.from_numpy(packing.tiles).to(texels.device), texels.reshape(-1, 3)
    for r_u, r_v, members in size_classes(tiles):
        for rows in members.split(max(1, chunk // (r_u * r_v))):
            at = texel_index(tiles[rows], (r_u, r_v), packing.width, packing.height)
            values = flat[at].permute(0, 3, 1, 2).contiguous()
            yield Reference(rows, (r_u, r_v), values, weights(shown, rows, (r_u, r_v)), 0)
