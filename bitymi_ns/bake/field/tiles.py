"""Tiles of a residual field (paper, section Texture Baking)."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Protocol

import torch
from torch import Tensor

from bitymi_ns.bundle.bake_options import BakeOptions
from bitymi_ns.codec.pages import listed_tiles
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.tile_sizes import (
    coarsened,
    kernel_parameters,
    nyquist_resolution,
    visible_extent,
    voxel_along_axes,
)
from bitymi_ns.train.init import tangents
from ..inputs import BakeInput
from ..prune import drop_unseen
from ..stages import Trained
from ..tile_errors import closest_pixels
from ..tiles import Tiles, grid

PAPER_EXTENT = 4.0  # e of the paper's rule


class Field(Protocol):
    """Provide what the bake uses of a residual field. Tiles follow the direction in which voxels are stretched if it
    also has `geometry.mid`, the centre of its contraction; else the smaller edge holds for both axes."""

    def __call__(self, x: Tensor) -> Tensor:
        """Map world positions [M, 3] to residual colours [M, 3]."""
        ...

    def voxel_size(self, x: Tensor) -> Tensor:
        """Map world positions [M, 3] to finest voxel edges [M, 2] (radial, tangential), world units."""
        ...


@torch.no_grad()
def field_tiles(
    baked: Trained,
    field: Field,
    cameras: Sequence[Camera],
    pixels_per_texel: float | None = None,
    progress: Progress = no_progress,
) -> Trained:
    """Drop the unseen surfels (`prune.drop_unseen`) of a bake that has no tiles yet, and make tiles with the values of
    a field at the texel centres.

    With a tolerance a tile covers the disc in which fragments reach the weight bound; beyond it the field is read at
    the nearest point of the disc. `cameras`: of the training views. `pixels_per_texel`: least number of pixels of the
    surfel per texel, in the view that shows most of it; None = as many texels as field and views resolve. Raises
    ValueError: no surfel is left, or the atlas would be too large."""
    options = baked.options
    means, scales = (baked.scene.surfels[name].to(baked.device) for name in ("means", "log_scales"))
    finest = torch.stack([field.voxel_size(part).amin() for part in means.split(options.chunk)]).amin()
    # the paper's rule: the smallest voxel size everywhere
    rates = (scales.exp(), finest.expand(scales.shape), PAPER_EXTENT)
    paper = _texels(nyquist_resolution(*rates, options.r_min, options.r_max))
    baked, inputs = drop_unseen(baked, cameras, progress)
    sizes, extent, counts = grids(inputs, field, options, pixels_per_texel)
    edges = tangents(inputs.surfels["quats"]) * inputs.surfels["log_scales"].exp()[:, None, :]
    texels = torch.zeros(int(sizes.long().clamp(min=1).prod(1).sum()), 3)
    done, tiled = 0, int((sizes[:, 0] > 0).sum())
    for size, rows, index in listed_tiles(sizes, options.chunk):
        u, v = grid(size, extent[rows])
        if options.tolerance > 0:
            inward = (extent[rows, None, None] / torch.hypot(u, v).clamp(min=1e-12)).clamp(max=1.0)
            u, v = u * inward, v * inward
        uv = torch.stack([u, v], dim=-1).flatten(1, 2)  # [n, r_v r_u, 2]
        x = inputs.surfels["means"][rows, None] + uv @ edges[rows].transpose(1, 2)
        texels[index.cpu()] = field(x.reshape(-1, 3)).float().view(*index.shape, 3).cpu()
        done += len(rows)
        progress("evaluating texels", done, tiled)
    bad = ~torch.isfinite(texels).all(1)
    texels[bad] = 0.0
    extent = torch.where(extent > 0, extent, options.extent)
    baked = baked.with_tiles(Tiles(sizes.cpu(), extent.cpu(), texels))
    counts |= {"paper": paper, "not_finite": int(bad.sum())}
    if pixels_per_texel is not None:
        counts["polished"] = baked.packing.texels
    return replace(baked, texel_counts=counts)


def grids(
    inputs: BakeInput, field: Field, options: BakeOptions, pixels_per_texel: float | None
) -> tuple[Tensor, Tensor, dict[str, int]]:
    """Choose the finest useful grids: sides [N, 2] int32, (0, 0) = none, and half sides [N], scale units; and texels by
    rule of `KeptTexels`."""
    surfels = inputs.surfels
    means = surfels["means"]
    scales = surfels["log_scales"].exp()
    axes = tangents(surfels["quats"])
    opacity, beta = kernel_parameters(surfels, inputs.transmittance)
    extent = torch.full_like(opacity, options.extent)
    if options.tolerance > 0:
        extent = torch.minimum(extent, visible_extent(opacity, beta, inputs.weight_bound))
    voxel = torch.cat([field.voxel_size(part) for part in means.split(options.chunk)])
    geometry = getattr(field, "geometry", None)
    center = None if geometry is None else torch.tensor(geometry.mid, dtype=torch.float32)
    delta = voxel_along_axes(voxel, axes, means, center) if options.local_voxel else voxel.amin().expand(scales.shape)
    pixels = None
    if inputs.cameras and options.cap_by_views:
        pixels = closest_pixels(surfels, inputs.cameras, options.extent, inputs.near)

    def sides(reach: Tensor, pixels: Tensor | None) -> Tensor:
        most = None if pixels is None else 2.0 * reach * pixels
        return nyquist_resolution(scales * reach, delta, 1.0, options.r_min, options.r_max, most)

    whole = torch.full_like(extent[:, None], options.extent)
    sizes = sides(extent[:, None], pixels)
    by_rule = {"nyquist": sides(whole, None), "after_cap_by_views": sides(whole, pixels), "within_visible_part": sizes}
    counts = {rule: _texels(chosen) for rule, chosen in by_rule.items()}
    if pixels_per_texel is not None and inputs.views is not None:
        sizes = coarsened(sizes, inputs.views.pixels / pixels_per_texel, options.r_min)
    return torch.where(extent[:, None] > 0, sizes, 0), extent, counts


def _texels(sizes: Tensor) -> int:
    return int(sizes.long().prod(1).sum())
