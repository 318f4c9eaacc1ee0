"""The residual field at the texel centres of an atlas, by the CUDA kernels."""

import torch
from torch import Tensor

from .backend import check_shapes, dense, kernel, require
from .constants import FRAME
from .field import FieldGeometry, kernel_field

WARP = 32  # texels that are evaluated together


@torch.no_grad()
def field_tiles(
    frames: Tensor,
    extent: Tensor,
    tiles: Tensor,
    pages: tuple[int, int, int],
    geometry: FieldGeometry,
    table: Tensor,
    w1: Tensor,
    w2: Tensor,
    w3: Tensor,
) -> tuple[Tensor, Tensor]:
    """rho at every texel centre, u = (i + 0.5) / r_u * 2 e - e and the same for v, x = mean + u s_u t_u + v s_v t_v.

    Args:
        frames: [N, 9] mean, s_u t_u, s_v t_v, world frame, on a CUDA device.
        extent: [N] e, half side of the tile in scale units.
        tiles: [N, 5] int32 x, y, layer, r_u, r_v in texels; r_u r_v = 0: no tile. They lie within the pages.
        pages: layers, height and width of the pages.
        geometry, table, w1, w2, w3: the field, as in `field`.

    Returns:
        [layers, height, width, 3], 0 outside the tiles and where the field is not finite; and [1] int32, the number of
        texels where it is not.

    Raises:
        ValueError: shapes do not agree.
        RuntimeError: the tensors are not on a CUDA device.
    """
    require("field_tiles", "cuda", frames.device, "move them there, or evaluate `field` at the texel centres")
    n = frames.shape[0]
    check_shapes(frames=(frames, (n, FRAME)), extent=(extent, (n,)), tiles=(tiles, (n, 5)))
    where = tiles.to(frames.device, torch.int32).contiguous()
    warps = -(-(where[:, 3].long() * where[:, 4].long()) // WARP)
    first = torch.cat([warps.new_zeros(1), warps.cumsum(0)])
    texels, bad = frames.new_zeros(*pages, 3), torch.zeros(1, dtype=torch.int32, device=frames.device)
    kernel("field_tiles", frames)(
        field=kernel_field(geometry, table, w1, w2, w3),
        frames=dense(frames, frames),
        extent=dense(extent, frames),
        tiles=where,
        first=first,
        warps=int(first[-1]),
        height=pages[1],
        width=pages[2],
        pages=texels,
        bad=bad,
    )
    return texels, bad
