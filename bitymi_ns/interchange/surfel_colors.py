"""Surfel colours for other programs: spherical harmonics, mean colour, mean residual."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch
from torch import Tensor

from bitymi_ns.bake.directions import view_directions
from bitymi_ns.bake.tiles import texel_centers
from bitymi_ns.bake.view_colors import shown_at
from bitymi_ns.codec.pages import size_classes, texel_index
from bitymi_ns.ops.constants import COLOR_BIAS, SUPPORT
from bitymi_ns.ops.view_kinds import fibonacci_sphere
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.tile_sizes import kernel_parameters
from . import harmonics

OUTSIDE, OUTSIDE_WEIGHT = 32, 0.1
"""Number of directions over the whole sphere, and their total weight relative to the viewing directions'."""


@dataclass(frozen=True)
class SurfelColors:
    """Colours of N surfels."""

    # [N, 16, 3] float32; the colour in the direction d from the camera is max(sum of harmonics Y(d) + 0.5, 0)
    harmonics: Tensor
    color: Tensor  # [N, 3] float32, mean colour without the residual, over the same directions


def rows_of(surfels: Mapping[str, Tensor], rows: Tensor) -> dict[str, Tensor]:
    """Select surfels by row, with all terms of reduced view colours."""
    return {name: value if name == "view_terms" else value[rows] for name, value in surfels.items()}


@torch.no_grad()
def fit_colors(scene: BakedScene, residual: Tensor | None, seen: Tensor, centers: Tensor) -> SurfelColors:
    """Fit spherical harmonics to the colours of surfels, by least squares over directions.

    The colour is max(max(f_view(d) + 0.5, 0) + residual, 0). Directions are those of `bake.directions`, with a total
    weight of 1, and OUTSIDE directions over the whole sphere with a total weight of OUTSIDE_WEIGHT; for a
    surfel that no view shows, these alone. `scene`: N surfels
    on the CPU. `residual`: [N, 3]; None: 0. `seen`: [V, N] bool; V may be 0. `centers`: [V, 3] float64 camera centres,
    the scene's frame."""
    surfels = scene.surfels
    means = surfels["means"]
    found = SurfelColors(means.new_zeros(len(means), harmonics.TERMS, 3), means.new_zeros(len(means), 3))
    outside = fibonacci_sphere(OUTSIDE)
    for at in view_directions(means, seen, centers):
        for part in torch.arange(len(at.rows)).split(1 << 12):
            rows = at.rows[part]
            directions = torch.cat([at.unit[part], outside.expand(len(rows), -1, -1)], dim=1)
            target = shown_at(scene.view_color, rows_of(surfels, rows), directions)
            near = at.valid[part].double()
            far = near.new_full((len(rows), OUTSIDE), OUTSIDE_WEIGHT / OUTSIDE)
            weight = torch.cat([near / near.sum(1, keepdim=True), far], dim=1)
            found.color[rows] = ((weight[..., None] * target).sum(1) / weight.sum(1, keepdim=True)).to(means)
            if residual is not None:
                target = torch.relu(target + residual[rows, None])
            fitted = weighted_fit(directions.double(), target.double() - COLOR_BIAS, weight)
            found.harmonics[rows] = fitted.to(means)
    return found


def weighted_fit(directions: Tensor, values: Tensor, weight: Tensor) -> Tensor:
    """Fit coefficients [n, 16, C] of harmonics to values [n, D, C] in directions [n, D, 3] with weights [n, D]."""
    columns = harmonics.basis(directions)
    weighted = (columns * weight[..., None]).transpose(1, 2)
    return torch.linalg.solve(weighted @ columns, weighted @ values)


@torch.no_grad()
def weighted_residuals(scene: BakedScene, chunk: int = 1 << 20) -> Tensor | None:
    """Average the residual of each surfel over its texels, weighted by kernel times alpha: [N, 3]; without a tile, its
    `mean_residual`. None: the scene has no residual."""
    if scene.mean_residual is None and scene.atlas is None:
        return None
    means = scene.surfels["means"]
    residual = means.new_zeros(len(means), 3) if scene.mean_residual is None else scene.mean_residual.clone()
    if scene.atlas is None:
        return residual
    extent = means.new_full((len(means),), SUPPORT) if scene.extent is None else scene.extent
    beta = kernel_parameters(scene.surfels)[1]
    _, height, width, _ = scene.atlas.shape
    flat, alphas = scene.residuals().reshape(-1, 3), scene.alphas()
    for r_u, r_v, rows in size_classes(scene.tiles[:, 3:]):
        for part in rows.split(max(1, chunk // (r_u * r_v))):
            u, v = (texel_centers(r, extent[part, None]) for r in (r_u, r_v))
            rest = (1 - (u[:, None, :].square() + v[:, :, None].square()) / SUPPORT**2).clamp(min=0)
            weight = (rest ** beta[part, None, None]).where(rest > 0, 0.0) + 1e-6
            index = texel_index(scene.tiles[part], (r_u, r_v), width, height)
            texels = flat[index]
            if alphas is not None:
                weight = weight * (alphas.flatten()[index] + 1e-6)
            residual[part] = (texels * weight[..., None]).sum((1, 2)) / weight.sum((1, 2))[:, None]
    return residual
