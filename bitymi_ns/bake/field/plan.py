"""Plan of the tiles of a field: extents, weights of errors, and the finest useful grids; and the field on these."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Protocol

import torch
from torch import Tensor

from bitymi_ns.bake.inputs import BakeInput
from bitymi_ns.bake.tile_errors import closest_pixels
from bitymi_ns.bake.tiles import TileValues, TileVisibility, fitted, grid, weights
from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.bundle.statistics import KeptTexels
from bitymi_ns.scene.tile_sizes import kernel_parameters, nyquist_resolution, visible_extent, voxel_along_axes
from bitymi_ns.train.init import tangents

PAPER_EXTENT = 4.0  # e of the paper's rule


class Field(Protocol):
    """The part of the residual field that the bake uses.

    A field that also has `geometry.mid`, the centre of its contraction, gets tiles that follow the direction in which
    its voxels are stretched; without it the smaller voxel edge holds for both axes.
    """

    def __call__(self, x: Tensor) -> Tensor:
        """[M, 3] world positions to [M, 3] residual colours."""

    def voxel_size(self, x: Tensor) -> Tensor:
        """[M, 3] world positions to [M, 2] finest voxel edges (radial, tangential), world units."""


@dataclass
class Plan(TileVisibility):
    """Extents and grids of N tiles, before the field is evaluated."""

    means: Tensor  # [N, 3] world positions
    edges: Tensor  # [N, 3, 2] tangent directions times scales, world units
    probes: Tensor  # [N, 2] int32, the grid on which the field is evaluated (along u, v), at least the Nyquist rate
    limit: Tensor  # [N, 2] int32, the finest tile of use, at most `probes`
    texels: KeptTexels  # number of texels by the rules before the tolerance
    whole: bool  # the field is evaluated in all of the square; else beyond the disc of radius `extent` at its rim

    def __len__(self) -> int:
        return len(self.means)


def make_plan(inputs: BakeInput, field: Field, options: BakeOptions, whole: bool = False) -> Plan:
    """Plan the extents and grids of all tiles.

    Args:
        inputs: surfels that are all finite and drawable, and the training views, for the cap and the weights.
        field: the residual field, for its voxel size.
        whole: every tile has the extent of the options and is probed at the texels of the rule; else it covers what
            reaches the weight bound and is probed at the Nyquist rate.
    """
    surfels = inputs.surfels
    means, scales = surfels["means"], surfels["log_scales"].exp()
    axes = tangents(surfels["quats"])
    opacity, beta = kernel_parameters(surfels, inputs.transmittance)
    extent = torch.full_like(opacity, options.extent)
    if not whole:
        extent = torch.minimum(extent, visible_extent(opacity, beta, inputs.weight_bound))
    geometry = getattr(field, "geometry", None)
    center = None if geometry is None else torch.tensor(geometry.mid, dtype=torch.float32)
    voxel = torch.cat([field.voxel_size(part) for part in means.split(options.chunk)])
    delta = voxel_along_axes(voxel, axes, means, center) if options.local_voxel else voxel.amin().expand(scales.shape)
    closest = closest_pixels(surfels, inputs.cameras, options.extent, inputs.near) if inputs.cameras else None
    pixels = None if closest is None or not options.cap_by_views else closest * (2.0 * options.extent)

    def grids(share: Tensor, pixels: Tensor | None) -> Tensor:
        capped = None if pixels is None else pixels * share
        return nyquist_resolution(scales * share, delta, options.extent, options.r_min, options.r_max, capped)

    share = extent[:, None] / options.extent
    limit = grids(share, pixels)
    probes = limit if whole else grids(share, None)
    full = torch.ones_like(share)
    counts = KeptTexels(
        nyquist=_texels(grids(full, None)),
        after_cap_by_views=_texels(grids(full, pixels)),
        within_visible_part=_texels(limit),
    )
    edges = axes * scales[:, None, :]
    tiles = (means, edges, probes, limit, counts, whole)
    return Plan(opacity, beta, extent, inputs.weight_bound, *tiles, pixels=closest)


def paper_texels(surfels: Mapping[str, Tensor], field: Field, options: BakeOptions) -> int:
    """Count the texels by the paper's rule: the smallest voxel size everywhere, and tiles of extent 4.

    Args:
        surfels: means [N, 3], log_scales [N, 2] of all surfels that can be drawn.
    """
    scales = surfels["log_scales"].exp()
    finest = torch.stack([field.voxel_size(part).amin() for part in surfels["means"].split(options.chunk)]).amin()
    sides = nyquist_resolution(scales, finest.expand(scales.shape), PAPER_EXTENT, options.r_min, options.r_max)
    return _texels(sides)


def _texels(sizes: Tensor) -> int:
    """Count the texels of tiles of sizes [N, 2]."""
    return int(sizes.long().prod(1).sum())


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
