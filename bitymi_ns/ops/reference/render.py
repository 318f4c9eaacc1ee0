"""Image formation in float64: brute-force visibility, texels, colours, weighted sums."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import torch
from torch import Tensor

from ..project import Pinhole
from .project import project
from .trace import SUPPORT, Trace, trace


@dataclass
class Render:
    """Rendered images; sums over the blended fragments, not divided by alpha."""

    rgb: Tensor  # [H, W, 3] sum of w c, plus the background times the remaining transmittance
    alpha: Tensor  # [H, W] sum of w
    depth: Tensor  # [H, W] sum of w z, camera z
    beta_map: Tensor  # [H, W] sum of w beta
    normal: Tensor  # [H, W, 3] sum of w n; n faces the camera, in the camera frame (OpenCV: x right, y down, z forward)
    overdraw: Tensor  # [H, W] int64, number of blended surfels
    trace: Trace


def texel_centers(resolution: int) -> Tensor:
    """Compute the texel centres along an axis, (i + 0.5) / r * 6 - 3 in surfel coordinates: [resolution] float64."""
    return (torch.arange(resolution, dtype=torch.float64) + 0.5) / resolution * (2 * SUPPORT) - SUPPORT


def texel(tile: Tensor, uv: Tensor, which: Tensor | None = None) -> Tensor:
    """Fetch colours [M, C] from a tile [r_v, r_u, C], which covers the support square [-3, 3]^2, at surfel coordinates
    [M, 2]: bilinear between texel centres, constant beyond the outer ones. `which`: [M] index among several tiles."""
    rows, columns = tile.shape[-3:-1]
    size = torch.tensor([columns, rows], dtype=uv.dtype, device=uv.device)
    position = (uv.clamp(-SUPPORT, SUPPORT) + SUPPORT) / (2 * SUPPORT) * size - 0.5  # [M, 2] texels
    position = torch.minimum(position.clamp(min=0), size - 1)
    low = position.detach().floor().long()
    high = torch.minimum(low + 1, size.long() - 1)
    fu, fv = (position - low)[:, :, None].unbind(1)  # [M, 1]
    first = () if which is None else (which,)
    top = tile[(*first, low[:, 1], low[:, 0])] * (1 - fu) + tile[(*first, low[:, 1], high[:, 0])] * fu
    bottom = tile[(*first, high[:, 1], low[:, 0])] * (1 - fu) + tile[(*first, high[:, 1], high[:, 0])] * fu
    return top * (1 - fv) + bottom * fv


def fetched(tiles: Sequence[Tensor], uv: Tensor, where: Tensor) -> Tensor:
    """Fetch texels [P, N, C] of N tiles [r_v, r_u, C] at coordinates [P, N, 2]; 0 outside the mask `where` [P, N]."""
    values = uv.new_zeros(*where.shape, tiles[0].shape[-1] if tiles else 3)
    for size in {tile.shape for tile in tiles}:  # tiles of one size at once
        rows = torch.tensor([i for i, tile in enumerate(tiles) if tile.shape == size])
        pixel, row = where[:, rows].nonzero(as_tuple=True)
        colors = texel(torch.stack([tiles[i] for i in rows.tolist()]), uv[pixel, rows[row]], row)
        values = values.index_put((pixel, rows[row]), colors)
    return values


def render(
    geometry: Sequence[Tensor],
    colors: Tensor,
    camera: Pinhole,
    background: Tensor | None = None,
    tiles: Sequence[Tensor] | None = None,
    residual: Callable[[Tensor], Tensor] | None = None,
    near: float = 0.2,
    rim: float = 0.0,
) -> Render:
    """Render surfels. Colour of a fragment: ReLU(f_view + 0.5), with texture ReLU(that + texture).

    Args:
        geometry: as for `project`.
        colors: [N, 3] view-dependent colour f_view(d) of each surfel, without the 0.5.
        background: [3]; None: black.
        tiles: a texture tile [r_v, r_u, 3] per surfel, or [r_v, r_u, 4] with factors of sigma.
        residual: residual colour field, world positions [M, 3] to colours [M, 3]; instead of `tiles`.
        near: as for `project`.
        rim: as for `trace`.
    """
    width, height = camera.width, camera.height
    p = project(*geometry, viewmat=camera.viewmat, K=camera.K, near=near)
    tiles = tiles or ()
    alphas = any(tile.shape[-1] == 4 for tile in tiles)
    factor = (lambda uv, where: fetched(tiles, uv, where)[..., 3]) if alphas else None
    t = trace(p, width, height, near, rim, factor=factor)
    base = torch.relu(colors + 0.5)  # [N, 3]
    color = base.expand(width * height, -1, -1)  # [P, N, 3]
    if tiles:
        color = torch.relu(color + fetched(tiles, t.uv, t.blended)[..., :3])
    if residual is not None:
        pixel, surfel = t.blended.nonzero(as_tuple=True)
        u, v = t.uv[pixel, surfel, :, None].unbind(1)  # [F, 1]
        mean, axis_u, axis_v = p.frame[surfel].unbind(1)  # [F, 3]
        texture = torch.zeros_like(color).index_put((pixel, surfel), residual(mean + u * axis_u + v * axis_v))
        color = torch.relu(color + texture)

    shape = (height, width)
    rgb = (t.weight[..., None] * color).sum(1)
    if background is not None:
        rgb = rgb + t.transmittance[:, None] * background
    return Render(
        rgb=rgb.reshape(*shape, 3),
        alpha=t.weight.sum(1).reshape(shape),
        depth=torch.where(t.blended, t.weight * t.depth, 0.0).sum(1).reshape(shape),
        beta_map=(t.weight @ p.beta).reshape(shape),
        normal=(t.weight @ p.normal).reshape(*shape, 3),
        overdraw=t.blended.sum(1).reshape(shape),
        trace=t,
    )
