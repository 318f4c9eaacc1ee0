"""The residual field on the grids of a plan."""

from collections.abc import Iterator

import torch

from bitymi_ns.bake.field.plan import Field, Plan
from bitymi_ns.bake.reduce import fitted
from bitymi_ns.bake.tiles import TileValues, grid, weights


@torch.no_grad()
def references(field: Field, plan: Plan, chunk: int = 1 << 18) -> Iterator[TileValues]:
    """Evaluate the field on the grids of the plan, in chunks of tiles of one size.

    The field is evaluated at the probes and fitted by least squares on the finest useful grid. With as many probes as
    texels the result is the field's values at the texel centres. With more probes, detail that no view resolves is
    averaged out instead of aliased. Beyond the disc of radius `extent` nothing is seen. Unless the plan is whole, the
    field is read there at the nearest point of the disc: values stay smooth and within the range of what is seen.

    Args:
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
            if not plan.whole:
                inward = (extent[:, None, None] / torch.hypot(u, v).clamp(min=1e-12)).clamp(max=1.0)
                u, v = u * inward, v * inward
            uv = torch.stack([u, v], dim=-1).flatten(1, 2)  # [n, pv pu, 2]
            x = plan.means[rows, None] + uv @ plan.edges[rows].transpose(1, 2)  # [n, pv pu, 3]
            value = field(x.reshape(-1, 3)).float()
            bad = ~torch.isfinite(value).all(dim=1)
            if bad.any():
                value = value.masked_fill(bad[:, None], 0.0)
            values = value.reshape(len(rows), pv, pu, 3).permute(0, 3, 1, 2).contiguous()
            if (pu, pv) != (lu, lv):
                values = fitted(values, (lu, lv))
            yield TileValues(rows, (lu, lv), values, weights(plan, rows, (lu, lv)), int(bad.sum()))
