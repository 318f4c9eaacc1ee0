"""What a tile has to hold: how far it is seen, how much an error in it counts, and the finest grid of use."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Protocol

import torch
from torch import Tensor

from bitymi_ns.bake.geometry import tangent_vectors
from bitymi_ns.bake.options import BakeOptions
from bitymi_ns.bake.resolution import max_projected_extent, nyquist_resolution, voxel_along_axes
from bitymi_ns.ops.constants import ALPHA_MAX, BETA_MAX, SUPPORT
from bitymi_ns.scene.camera import Camera

STEPS = 255.0  # 8-bit steps in a colour of 1
PAPER_EXTENT = 4.0  # e of the paper's rule
MARGIN = 1.5
"""Held-out views may see more of a surfel than the training views do: its transmittance is taken this much larger."""


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
class Plan:
    """What is known of every tile before the field is looked at.

    Attributes:
        means: [N, 3] world positions.
        edges: [N, 3, 2] tangent directions times scales, world units.
        opacity: [N] largest blending weight of the surfel's centre.
        beta: [N] exponent of the kernel.
        extent: [N] half side of the tile in scale units: beyond it every fragment stays below the weight bound; 0 where
            all do.
        probes: [N, 2] int32, the grid on which the field is evaluated (along u, v), at least the Nyquist rate.
        limit: [N, 2] int32, the finest tile of use, at most `probes`.
        weight_bound: fragments of smaller weight get no residual.
        texels: how many texels the rules before the tolerance give: nyquist, after_cap_by_views, and
            within_visible_part, where tiles cover `extent` only.
    """

    means: Tensor
    edges: Tensor
    opacity: Tensor
    beta: Tensor
    extent: Tensor
    probes: Tensor
    limit: Tensor
    weight_bound: float
    texels: dict[str, int] = field(default_factory=dict)

    def __len__(self) -> int:
        return len(self.means)


def kernel_parameters(surfels: Mapping[str, Tensor], transmittance: Tensor | None = None) -> tuple[Tensor, Tensor]:
    """Largest blending weight at the centre, and exponent of the kernel, of every surfel: [N], [N].

    Args:
        surfels: opacity_logits [N], beta_raw [N].
        transmittance: [N] of `Visibility`; None = nothing is in front of any surfel.
    """
    opacity = surfels["opacity_logits"].sigmoid().clamp(max=ALPHA_MAX)
    if transmittance is not None:
        opacity = opacity * (MARGIN * transmittance).clamp(max=1.0)
    return opacity, BETA_MAX * surfels["beta_raw"].sigmoid()


def visible_extent(opacity: Tensor, beta: Tensor, weight_bound: float) -> Tensor:
    """Radius in scale units at which opacity * (1 - r^2 / 9)^beta falls to the weight bound: [N], 0 where all is below.

    What the low pass or the pixel spreads beyond it, about a pixel, reads the tile's edge.
    """
    rest = (weight_bound / opacity.clamp(min=1e-12)).clamp(max=1.0) ** (1.0 / beta.clamp(min=1e-6))
    return SUPPORT * (1.0 - rest).clamp(min=0.0).sqrt()


def make_plan(
    surfels: Mapping[str, Tensor],
    field: Field,
    options: BakeOptions,
    cameras: Sequence[Camera] = (),
    transmittance: Tensor | None = None,
    near: float = 0.2,
    weight_bound: float = 0.0,
) -> Plan:
    """Extents and grids of all tiles.

    Args:
        surfels: per-surfel parameters, N rows, all finite and drawable.
        field: the residual field, for its voxel size.
        options: sizes and tolerance; without a tolerance every tile has the extent of the options and is probed at the
            texels of the rule.
        cameras: training views, for the cap.
        transmittance: [N] of `Visibility`, None = 1.
        near: nearest drawn depth.
        weight_bound: fragments of smaller weight get no residual.
    """
    means, scales = surfels["means"], surfels["log_scales"].exp()
    axes = tangent_vectors(surfels["quats"])
    opacity, beta = kernel_parameters(surfels, transmittance)
    extent = torch.full_like(opacity, options.extent)
    if options.tolerance > 0:
        extent = torch.minimum(extent, visible_extent(opacity, beta, weight_bound))
    voxel = torch.cat([field.voxel_size(part) for part in means.split(options.chunk)])
    delta = (
        voxel_along_axes(voxel, axes, means, _center(field))
        if options.local_voxel
        else voxel.amin().expand(scales.shape)
    )
    pixels = None
    if cameras and options.cap_by_views:
        pixels = max_projected_extent(means, axes, scales, cameras, options.extent, near)[0]

    def grids(share: Tensor, pixels: Tensor | None) -> Tensor:
        capped = None if pixels is None else pixels * share
        return nyquist_resolution(scales * share, delta, options.extent, options.r_min, options.r_max, capped)

    share = extent[:, None] / options.extent
    limit = grids(share, pixels)
    probes = grids(share, None) if options.tolerance > 0 else limit
    whole = torch.ones_like(share)
    texels = {
        "nyquist": grids(whole, None),
        "after_cap_by_views": grids(whole, pixels),
        "within_visible_part": limit,
    }
    counts = {name: int(sizes.long().prod(1).sum()) for name, sizes in texels.items()}
    edges = axes * scales[:, None, :]
    return Plan(means, edges, opacity, beta, extent, probes, limit, weight_bound, counts)


def paper_texels(surfels: Mapping[str, Tensor], field: Field, options: BakeOptions) -> int:
    """How many texels the paper's rule gives: one voxel size, the smallest, and tiles of extent 4.

    Args:
        surfels: means [N, 3], log_scales [N, 2] of all surfels that can be drawn.
        field: the whole residual field.
        options: smallest and largest tile.
    """
    scales = surfels["log_scales"].exp()
    finest = torch.stack([field.voxel_size(part).amin() for part in surfels["means"].split(options.chunk)]).amin()
    sides = nyquist_resolution(scales, finest.expand(scales.shape), PAPER_EXTENT, options.r_min, options.r_max)
    return int(sides.long().prod(1).sum())


def _center(field: Field) -> Tensor | None:
    """[3] centre of the field's contraction, world frame, if it tells."""
    geometry = getattr(field, "geometry", None)
    return None if geometry is None else torch.tensor(geometry.mid, dtype=torch.float32)


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
    """along_v x along_u^T of every channel: [n, 3, V, U] with [u, U], [v, V] -> [n, 3, v, u]."""
    y = (x @ along_u.T).transpose(2, 3)  # one product of matrices each
    return (y.contiguous() @ along_v.T).transpose(2, 3).contiguous()


def grid(count: tuple[int, int], extent: Tensor) -> tuple[Tensor, Tensor]:
    """Surfel coordinates of evenly spaced points (cell centres) of the tiles: u, v [n, count_v, count_u]."""
    u, v = ((2.0 * torch.arange(c, device=extent.device) + 1.0) / c - 1.0 for c in count)
    e = extent[:, None, None]
    return (e * u[None, None, :]).expand(-1, count[1], -1), (e * v[None, :, None]).expand(-1, -1, count[0])


def weights(plan: Plan, rows: Tensor, count: tuple[int, int]) -> Tensor:
    """Largest blending weight of a fragment at the points of `grid`: [n, count_v, count_u]; 0 without residual."""
    u, v = grid(count, plan.extent[rows])
    rest = 1.0 - (u.square() + v.square()) / SUPPORT**2
    weight = plan.opacity[rows, None, None] * rest.clamp(min=1e-12) ** plan.beta[rows, None, None]
    return torch.where((rest > 0) & (weight >= plan.weight_bound), weight, torch.zeros_like(weight))


def weighted_rms(difference: Tensor, weight: Tensor) -> Tensor:
    """Root mean square of difference [n, 3, v, u] times weight [n, v, u] where that is not 0, in 8-bit steps: [n]."""
    count = 3 * (weight > 0).flatten(1).sum(1).clamp(min=1)
    square = (difference.square().sum(1) * weight.square()).flatten(1).sum(1)
    return STEPS * (square / count).sqrt()


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

    The field is evaluated at the probes and fitted by least squares on the finest grid of use: with as many probes as
    texels these are the field's values at the texel centres; with more, detail that no view resolves is averaged out
    instead of aliased. Beyond the disc of radius `extent`, where nothing is seen, the field is read at the nearest
    point of the disc: smooth, and within the range of what is seen.

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
                values = along_axes(values, fit(pu, lu).to(values), fit(pv, lv).to(values))
            yield Reference(rows, (lu, lv), values, weights(plan, rows, (lu, lv)), int(bad.sum()))
