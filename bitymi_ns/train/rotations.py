"""Quaternions (w, x, y, z) of surfels: the few operations that initialisation and splitting need."""

from __future__ import annotations

import torch
from torch import Tensor


def facing(normals: Tensor, angles: Tensor) -> Tensor:
    """Rotations that turn the z axis to a normal after turning the disc in its plane.

    Args:
        normals: [N, 3] unit vectors.
        angles: [N] in radians, rotation about z before the tilt.

    Returns:
        [N, 4] unit quaternions.
    """
    x, y, z = normals.unbind(-1)
    zero = torch.zeros_like(x)
    tilt = torch.stack([1.0 + z, -y, x, zero], -1)  # shortest rotation from (0, 0, 1); vanishes at -z
    flip = torch.tensor([0.0, 1.0, 0.0, 0.0], dtype=tilt.dtype, device=tilt.device)
    tilt = torch.where((tilt.norm(dim=-1) < 1e-4)[:, None], flip, tilt)
    w, i, j, k = (tilt / tilt.norm(dim=-1, keepdim=True)).unbind(-1)
    cos, sin = torch.cos(angles / 2), torch.sin(angles / 2)
    return torch.stack([w * cos - k * sin, i * cos + j * sin, j * cos - i * sin, k * cos + w * sin], -1)


def tangents(quats: Tensor) -> Tensor:
    """The two tangent directions of surfels: the first two columns of their rotation matrices.

    Args:
        quats: [N, 4], not normalised; a zero quaternion counts as no rotation.

    Returns:
        [N, 3, 2] unit vectors; [..., 0] is the u axis, [..., 1] the v axis.
    """
    norm = quats.norm(dim=-1, keepdim=True)
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=quats.dtype, device=quats.device)
    w, x, y, z = torch.where(norm > 0, quats / norm.clamp(min=torch.finfo(quats.dtype).tiny), identity).unbind(-1)
    u = torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y + w * z), 2 * (x * z - w * y)], -1)
    v = torch.stack([2 * (x * y - w * z), 1 - 2 * (x * x + z * z), 2 * (y * z + w * x)], -1)
    return torch.stack([u, v], -1)
