"""Baked scene as a textured mesh: an opaque quad per surfel."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bitymi_ns.codec.packing import GRID, pack
from bitymi_ns.codec.pages import size_classes, texel_alpha, texel_index
from bitymi_ns.ops.constants import SUPPORT
from bitymi_ns.scene.baked import BakedScene
from bitymi_ns.scene.tile_sizes import kernel_parameters, next_power_of_two
from bitymi_ns.train.init import tangents
from .frame import Similarity

MASK = 0.5  # alpha cutoff
_CORNERS = ((-1.0, -1.0), (1.0, -1.0), (1.0, 1.0), (-1.0, 1.0))
_CHUNK = 1 << 20  # texels per batch


@dataclass(frozen=True)
class Quads:
    """Q textured parallelograms."""

    corners: Tensor  # [Q, 4, 3] float32 positions, in a ring
    uv: Tensor  # [Q, 4, 2] float32 texture coordinates of the corners, as in glTF
    page: Tensor  # [Q] int64
    pages: Tensor  # [P, height, width, 4] uint8 RGBA, with alpha cutoff `MASK`

    def __len__(self) -> int:
        return len(self.corners)

    def moved(self, to: Similarity) -> Quads:
        return replace(self, corners=to.points(self.corners))


@torch.no_grad()
def quads_of(scene: BakedScene, color: Tensor, level: float) -> Quads:
    """Convert the surfels of a scene on the CPU, with its texels decoded, to quads.

    A quad is the square around the disc in which the surfel's opacity o k = o (1 - r^2 / R^2)^beta is at least `level`,
    in (0, 1). Alpha is 1 - r^2 / (2 radius^2), 0.5 at the disc's rim; with alpha texels m the disc is that of the
    largest m, and alpha at most o k m / (2 level). Colours are max(color + residual, 0), with `color` [N, 3]. Texels
    are resampled at about the tile's resolution, with the outer texel centres at the corners."""
    surfels = scene.surfels
    opacity = torch.sigmoid(surfels["opacity_logits"].double()) * _largest_alpha(scene)
    kept = torch.nonzero(opacity > level).squeeze(1)
    falloff = (level / opacity[kept]) ** (1.0 / kernel_parameters(surfels)[1][kept].double().clamp(min=1e-6))
    radius = (SUPPORT * (1.0 - falloff).clamp(min=1e-12).sqrt()).float()
    extent = torch.full_like(radius, SUPPORT) if scene.extent is None else scene.extent[kept]
    covered = scene.tiles[kept, 3:] * (radius / extent)[:, None]  # texels; the tile's resolution is kept
    size = next_power_of_two(covered.ceil()).clamp(min=GRID).long()
    packing = pack(size.numpy())
    tiles = torch.from_numpy(packing.tiles)
    pages = torch.zeros(packing.layers * packing.height * packing.width, 4, dtype=torch.uint8)
    for r_u, r_v, rows in size_classes(tiles[:, 3:]):
        for part in rows.split(max(1, _CHUNK // (r_u * r_v))):
            texels = _texels(scene, color, kept[part], (r_u, r_v), radius[part], extent[part], level)
            pages[texel_index(tiles[part], (r_u, r_v), packing.width, packing.height)] = texels
    ring = torch.tensor(_CORNERS)
    axes = tangents(surfels["quats"][kept]) * surfels["log_scales"][kept].exp()[:, None] * radius[:, None, None]
    corners = surfels["means"][kept, None] + torch.einsum("nka,ca->nck", axes, ring)
    first, count = tiles[:, None, :2].double(), tiles[:, None, 3:].double()
    uv = (first + 0.5 + 0.5 * (ring + 1.0) * (count - 1.0)) / torch.tensor([packing.width, packing.height])
    shape = (packing.layers, packing.height, packing.width, 4)
    return Quads(corners.float(), uv.float(), tiles[:, 2].long(), pages.view(shape))


def fetch_texels(scene: BakedScene, tiles: Tensor, u: Tensor, v: Tensor) -> Tensor:
    """Fetch texels of tiles [n, 5] int64 bilinearly, clamped to their outer texel centres, on the CPU: [n, r_v, r_u, 4]
    residual colour and alpha, 0 without alpha texels. `u`, `v`: [n, r_u], [n, r_v] in half sides of the tiles."""
    assert scene.atlas is not None
    _, height, width, _ = scene.atlas.shape
    (low_u, high_u, fu), (low_v, high_v, fv) = (
        _between(at, tiles[:, 3 + i], tiles[:, i]) for i, at in enumerate((u, v))
    )
    layer = tiles[:, 2, None, None] * height
    texels = scene.atlas.view(-1, 4)
    unit = 255.0 if texels.dtype == torch.uint8 else 1.0
    scale, offset = torch.tensor([[scene.scale] * 3 + [scene.alpha_scale], [scene.offset] * 3 + [0.0]])

    def fetch(x: Tensor, y: Tensor) -> Tensor:
        return texels[(layer + y[:, :, None]) * width + x[:, None]].float() / unit * scale + offset

    return bilinear(fetch, (low_u, low_v), (high_u, high_v), (fu[:, None, :, None], fv[:, :, None, None]))


def bilinear(
    fetch: Callable[[Tensor, Tensor], Tensor], low: Sequence[Tensor], high: Sequence[Tensor], weights: Sequence[Tensor]
) -> Tensor:
    """Interpolate what `fetch` returns for x, y between `low` and `high`, by the weights of the high ones."""
    (x, y), (next_x, next_y), (fu, fv) = low, high, weights
    top = fetch(x, y) * (1 - fu) + fetch(next_x, y) * fu
    bottom = fetch(x, next_y) * (1 - fu) + fetch(next_x, next_y) * fu
    return top * (1 - fv) + bottom * fv


def _between(at: Tensor, count: Tensor, first: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Compute the texels around positions [n, r] in [-1, 1] along an axis, and the weights of the later ones."""
    last = (count - 1)[:, None]
    x = ((0.5 * (at + 1.0)) * count[:, None] - 0.5).clamp(min=0.0)
    x = torch.minimum(x, last.to(x))
    low = x.floor().long()
    return low + first[:, None], torch.minimum(low + 1, last) + first[:, None], x - low


def _texels(
    scene: BakedScene, color: Tensor, rows: Tensor, size: tuple[int, int], radius: Tensor, extent: Tensor, level: float
) -> Tensor:
    """Sample the textures [n, r_v, r_u, 4] uint8 of quads of one size."""
    across, down = (torch.linspace(-1.0, 1.0, count) for count in size)
    r2 = across.square() + down[:, None].square()  # squared radius, relative to the disc's
    shown = color[rows, None, None].expand(-1, size[1], size[0], -1)
    if scene.mean_residual is not None:
        shown = shown + scene.mean_residual[rows, None, None]
    alpha = (1.0 - 0.5 * r2).clamp(min=0.0).expand(len(rows), -1, -1)
    tiled = torch.nonzero(scene.tiles[rows, 3] > 0).squeeze(1)
    if scene.atlas is not None and len(tiled):
        u, v = (axis * (radius / extent)[tiled, None] for axis in (across, down))
        shown, alpha, own = shown.clone(), alpha.clone(), rows[tiled]
        texels = fetch_texels(scene, scene.tiles[own].long(), u, v)
        shown[tiled] = color[own, None, None] + texels[..., :3]
        if scene.alpha_scale:
            opacity, beta = (value[own, None, None] for value in kernel_parameters(scene.surfels))
            # clamped to the rim's value beyond the rim
            uncut = opacity * (1.0 - r2.clamp(max=1.0) * (radius[tiled, None, None] / SUPPORT).square()) ** beta
            alpha[tiled] = torch.minimum(alpha[tiled], 0.5 * uncut * texels[..., 3] / level)
    return (torch.cat([shown, alpha[..., None]], dim=3).clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)


def _largest_alpha(scene: BakedScene) -> Tensor:
    """Compute the largest alpha [N] of each surfel's texels; 1 for opaque texels."""
    alpha = texel_alpha(scene)
    if alpha is None:
        return torch.ones(len(scene), dtype=torch.float64)
    surfel = torch.arange(len(scene)).repeat_interleave(alpha.tiles.size.long().prod(dim=1))
    return torch.zeros(len(scene)).scatter_reduce(0, surfel, alpha.values, "amax").double()
