"""Bilinear fetch from a surfel's texture tile, in float64."""

import torch
from torch import Tensor

from bitymi_ns.ops.reference.trace import SUPPORT


def texel_centers(resolution: int) -> Tensor:
    """Surfel coordinates [resolution] float64 of the texel centres along one axis: (i + 0.5) / r * 6 - 3."""
    return (torch.arange(resolution, dtype=torch.float64) + 0.5) / resolution * (2 * SUPPORT) - SUPPORT


def texel(tile: Tensor, uv: Tensor, of: Tensor | None = None) -> Tensor:
    """Colour of a tile at surfel coordinates: bilinear between texel centres, constant beyond the outer ones.

    Args:
        tile: [r_v, r_u, C], or K of them; a tile covers the support square [-3, 3]^2.
        uv: [M, 2] in scale units.
        of: [M] which of K tiles.

    Returns:
        [M, C].
    """
    rows, columns = tile.shape[-3:-1]
    size = torch.tensor([columns, rows], dtype=uv.dtype, device=uv.device)
    position = (uv.clamp(-SUPPORT, SUPPORT) + SUPPORT) / (2 * SUPPORT) * size - 0.5  # [M, 2] texels
    position = torch.minimum(position.clamp(min=0), size - 1)
    low = position.detach().floor().long()
    high = torch.minimum(low + 1, size.long() - 1)
    fu, fv = (position - low)[:, :, None].unbind(1)  # [M, 1]
    at = () if of is None else (of,)
    top = tile[(*at, low[:, 1], low[:, 0])] * (1 - fu) + tile[(*at, low[:, 1], high[:, 0])] * fu
    bottom = tile[(*at, high[:, 1], low[:, 0])] * (1 - fu) + tile[(*at, high[:, 1], high[:, 0])] * fu
    return top * (1 - fv) + bottom * fv
