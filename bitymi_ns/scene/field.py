"""Residual colours of a scene as modules: a field in space, or texels on every surfel."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar, TypeVar

import torch
from torch import Tensor, nn

from bitymi_ns.ops import Fragments, TexelAlpha, TexelDescent, TexelTiles, fragment_residual
from bitymi_ns.ops.backend import version_of
from bitymi_ns.ops.constants import FEATURES, WIDTH
from bitymi_ns.ops.field import FieldGeometry, field
from .config import SceneConfig

T = TypeVar("T")


def _current(cached: tuple[Tensor, int, T] | None, buffer: Tensor) -> T | None:
    """Return a cached value if it is of a buffer's current version."""
    return cached[2] if cached is not None and cached[0] is buffer and cached[1] == version_of(buffer) else None


class HashField(nn.Module):
    """Multiresolution hash grid and MLP: view-independent residual colour rho(x), eq. (color).

    The last layer, and so the residual, is initially 0; table entries are U(-1e-4, 1e-4).

    Args:
        mid: centre of the domain, world.
        half: radius of the uncontracted ball, or half edge of the box, world units.
        contract: contract space outside the ball.
        log2_table_size: log2 of the entries per level.
    """

    domain: Tensor

    def __init__(
        self,
        config: SceneConfig,
        mid: tuple[float, float, float],
        half: float,
        contract: bool,
        log2_table_size: int,
        generator: torch.Generator | None = None,
    ) -> None:
        super().__init__()
        self.levels, self.min_resolution = config.levels, config.min_resolution
        self._moves_surfels = config.texture_moves_surfels

        def uniform(bound: float, *shape: int) -> nn.Parameter:
            return nn.Parameter((torch.rand(*shape, generator=generator, dtype=torch.float32) * 2 - 1) * bound)

        inputs = config.levels * FEATURES
        self.field_table = uniform(1e-4, config.levels, 1 << log2_table_size, FEATURES)
        # He's rule for ReLU layers
        self.field_w1 = uniform((6 / inputs) ** 0.5, inputs, WIDTH)
        self.field_w2 = uniform((6 / WIDTH) ** 0.5, WIDTH, WIDTH)
        self.field_w3 = nn.Parameter(torch.zeros(WIDTH, 3, dtype=torch.float32))
        # a buffer, so that checkpoints contain it
        self.register_buffer("domain", torch.tensor([*mid, half, float(contract)], dtype=torch.float64))
        self._geometry: tuple[Tensor, int, FieldGeometry] | None = None

    @property
    def geometry(self) -> FieldGeometry:
        """Geometry of the grid. Cached, to avoid a synchronisation in every step."""
        geometry = _current(self._geometry, self.domain)
        if geometry is None:
            x, y, z, half, contract = self.domain.tolist()
            geometry = FieldGeometry(self.min_resolution, bool(contract), (x, y, z), half)
            self._geometry = (self.domain, version_of(self.domain), geometry)
        return geometry

    @property
    def weights(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """Table and MLP weights, in the order of the arguments of `ops.field`."""
        return self.field_table, self.field_w1, self.field_w2, self.field_w3

    def residual(self, fragments: Fragments, frames: Tensor, bound: float, learns: bool) -> Tensor:
        """Compute the residual colours [F, 3] of a view's fragments, with gradients if `learns`. `frames`: [N, 9] of
        its `Projection`. `bound`: fragments of smaller weight have none."""
        weights = self.weights if learns else tuple(w.detach() for w in self.weights)
        return fragment_residual(fragments, frames, self.geometry, weights, bound, learns and self._moves_surfels)

    def forward(self, x: Tensor) -> Tensor:
        """Compute the residual colour [M, 3] at world positions [M, 3]."""
        return field(x, self.geometry, *self.weights)

    def voxel_size(self, x: Tensor) -> Tensor:
        """Compute the radial and tangential edge, [M, 2] world units, of the finest voxel at world positions [M, 3].

        Outside the unit ball the contraction stretches a voxel by r^2 radially and by r / (2 - 1/r) tangentially."""
        g = self.geometry
        finest = g.min_resolution << (self.levels - 1)
        if not g.contract:
            return torch.full((x.shape[0], 2), 2 * g.half / finest, dtype=x.dtype, device=x.device)
        r = ((x - x.new_tensor(g.mid)) / g.half).norm(dim=-1).clamp_min(1.0)
        return (4 * g.half / finest) * torch.stack([r * r, r / (2 - 1 / r)], dim=-1)


class TexelField(nn.Module):
    """Residual colours of N surfels in texels, one tile per surfel, as in a bundle.

    Args:
        size: [N, 2] int32 sides of the tiles along u and v, texels.
        extent: [N] half sides of the tiles in scale units.
        texels: [T, 3] initial residual colours, tile after tile as in `TexelTiles.of_sizes`.
        share: [T] step size of each texel, see `TexelDescent`; None: texels are not optimised.
        alpha: [T] factors of the surfel's opacity, from 0 to 2, see `ops.TexelAlpha`; None: opaque texels.
    """

    STEADY: ClassVar = ("size", "extent", "share")
    """Buffers that training never modifies in place, so that copies of the scene may share them."""

    size: Tensor
    extent: Tensor
    share: Tensor

    def __init__(
        self,
        size: Tensor,
        extent: Tensor,
        texels: Tensor,
        share: Tensor | None = None,
        alpha: Tensor | None = None,
    ) -> None:
        super().__init__()
        self.texels = nn.Parameter(texels.detach().clone())
        self.alpha = None if alpha is None else nn.Parameter(alpha.detach().clone())
        # buffers, so that checkpoints contain them
        self.register_buffer("size", size.to(torch.int32).clone())
        self.register_buffer("extent", extent.detach().to(texels).clone())
        self.register_buffer("share", texels.new_zeros(len(texels)) if share is None else share.detach().clone())
        self._tiles: tuple[Tensor, int, TexelTiles] | None = None

    @classmethod
    def blank(cls, surfels: int, texels: int, like: Tensor, alpha: bool = False) -> TexelField:
        """Create an empty field for `load_state_dict`."""
        size = torch.zeros(surfels, 2, dtype=torch.int32, device=like.device)
        factors = like.new_ones(texels) if alpha else None
        return cls(size, like.new_zeros(surfels), like.new_zeros(texels, 3), alpha=factors)

    @property
    def tiles(self) -> TexelTiles:
        """Sizes and texel offsets of the surfels' tiles."""
        tiles = _current(self._tiles, self.size)
        if tiles is None:
            tiles = TexelTiles.of_sizes(self.size, self.extent)
            self._tiles = (self.size, version_of(self.size), tiles)
        return tiles

    @torch.no_grad()
    def keep(self, rows: Tensor) -> None:
        """Keep the surfels `rows` [n] int64, in that order."""
        old = self.tiles.rows_of(rows)
        self.texels = nn.Parameter(self.texels.detach()[old])
        self.alpha = None if self.alpha is None else nn.Parameter(self.alpha.detach()[old])
        self.share = self.share[old]
        self.size = self.size[rows]
        self.extent = self.extent[rows]

    def texture(
        self, bound: float, learns: bool, descent: TexelDescent | None = None, read: Tensor | None = None
    ) -> dict[str, Any]:
        """Return the arguments of `blended_image`.

        Args:
            bound, learns: as in `opacity`.
            descent: update of the texels by the backward pass; None: they get a gradient.
            read: copy of the texels before the backward pass, for a view rendered in bands.
        """
        texels = self.texels if learns and descent is None else self.texels.detach()
        if descent is not None and read is not None:
            texels, descent = read, replace(descent, moved=texels)
        # tiles move with their surfels, so gradients of texels with respect to position belong to the surfels
        return {"texels": texels, "tiles": self.tiles, "bound": bound, "move_surfels": learns, "descent": descent}

    def opacity(self, bound: float, learns: bool) -> TexelAlpha | None:
        """Return opacities of texels, with gradients if `learns`; None: opaque texels."""
        if self.alpha is None:
            return None
        return TexelAlpha(self.tiles, self.alpha if learns else self.alpha.detach(), bound)
