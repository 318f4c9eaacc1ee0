"""Tangent frames of surfels and the points of their texture tiles."""

from __future__ import annotations

import torch
from torch import Tensor

from bitymi_ns.train.rotations import tangents


def tangent_vectors(quats: Tensor) -> Tensor:
    """The two tangent directions of surfels: the first two columns of their rotation matrices.

    Args:
        quats: [N, 4] quaternions wxyz, of any length but zero.

    Returns:
        [N, 3, 2] unit vectors in the world frame; [..., 0] is the u axis, [..., 1] the v axis.
    """
    return torch.stack(tangents(quats), dim=-1)


def texel_centres(count: int, extent: float, *, device: torch.device | str = "cpu") -> Tensor:
    """Surfel coordinates of the texel centres along one axis: (i + 0.5) / count * 2 extent - extent.

    Args:
        count: texels along the axis.
        extent: half side of the tile's square in scale units (e; 3 covers exactly the support).

    Returns:
        [count] float32.
    """
    i = torch.arange(count, dtype=torch.float32, device=device)
    return (i + 0.5) * (2.0 * extent / count) - extent


def tile_points(means: Tensor, axes: Tensor, size: tuple[int, int], extent: float) -> Tensor:
    """World positions of the texel centres of tiles that share one size: mean + u s_u R[:,0] + v s_v R[:,1].

    Args:
        means: [N, 3] world positions.
        axes: [N, 3, 2] tangent directions times the scales, world units.
        size: (r_u, r_v) texels along u and v.
        extent: half side of the tile in scale units.

    Returns:
        [N, r_v, r_u, 3] world positions; rows run along v.
    """
    u = texel_centres(size[0], extent, device=means.device)  # [r_u]
    v = texel_centres(size[1], extent, device=means.device)  # [r_v]
    across = u[:, None] * axes[:, None, :, 0]  # [N, r_u, 3]
    down = v[:, None] * axes[:, None, :, 1]  # [N, r_v, 3]
    return means[:, None, None, :] + across[:, None, :, :] + down[:, :, None, :]
