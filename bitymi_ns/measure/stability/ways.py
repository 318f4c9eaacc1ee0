"""Ways to draw a scene: what else of the operations is measured on the same numbers that misbehave."""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from bitymi_ns.measure.stability.scenes import SceneCase
from bitymi_ns.ops import TexelTiles
from bitymi_ns.ops.constants import SUPPORT

RIM = 1e-3
"""Bound of the kernel's derivative at the rim, the default of a scene, for the gradients on both sides."""
TEXELS = "texels"
"""Name of the texels among the parameters of a case."""
TILE = (8, 4)
"""Sides of a tile of a case, texels along u and v."""
ON_A_TEXEL = 1e-6
"""Coordinates that are nearer than this to a texel's centre, as a share of the tile, may lie on either side of it."""


@dataclass(frozen=True)
class Way:
    """One way to draw.

    Attributes:
        name: short, for tables and tests.
        texels: every surfel has a tile of random texels; the gradient reaches them and, through the fetch, u and v.
        through_pixel: the kernel is seen through a pixel (`prefilter: pixel`).
        rim: bound of the derivative at the rim on both sides, `Scene.rim`. Through a pixel the bound is another
            one, that of the kernel averaged over the pixel, which the reference does not have: 0 turns it off.
    """

    name: str
    texels: bool = False
    through_pixel: bool = False
    rim: float = RIM

    def of(self, case: SceneCase) -> SceneCase:
        """The case with what this way asks for."""
        if not self.texels:
            return case
        n = len(case.params["means"])
        random = torch.randn(n * TILE[0] * TILE[1], 3, generator=torch.Generator().manual_seed(7), dtype=torch.float64)
        return replace(case, params={**case.params, TEXELS: 0.2 * random})


PLAIN = Way("plain")
WAYS = (Way(TEXELS, texels=True), Way("pixel", through_pixel=True, rim=0.0))
"""Those beside the plain one."""


def tiles_of(texels: Tensor) -> TexelTiles:
    """Tiles of TILE texels each for the surfels' texels [T, 3]."""
    n = len(texels) // (TILE[0] * TILE[1])
    size = torch.tensor(TILE, dtype=torch.int32, device=texels.device).expand(n, 2)
    return TexelTiles.of_sizes(size, texels.new_full((n,), float(SUPPORT)))


def tile_images(texels: Tensor) -> list[Tensor]:
    """The same as one image [r_v, r_u, 3] per surfel."""
    return list(texels.view(-1, TILE[1], TILE[0], 3).unbind())  # one backward pass for all of them


def cells(uv: Tensor) -> Tensor:
    """Between which texels' centres coordinates [..., 2] lie, which decides the slope of the fetch: [...] int64, -1
    where rounding does."""
    size = torch.tensor(TILE, dtype=torch.float64, device=uv.device)
    at = (uv.detach().double().clamp(-SUPPORT, SUPPORT) + SUPPORT) / (2 * SUPPORT) * size - 0.5  # -0.5 to size - 0.5
    column, row = (at.floor().long() + 1).unbind(-1)
    decided = ((at - at.round()).abs() > ON_A_TEXEL * size).all(-1)
    return torch.where(decided, column + (TILE[0] + 1) * row, -1)
