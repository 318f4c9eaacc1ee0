"""Residual colour field in float64: contraction of space, multiresolution hash encoding, small MLP."""

import itertools

import torch
from torch import Tensor

PRIMES = (1, 2654435761, 805459861)


def contract(x: Tensor, mid: Tensor, half: Tensor | float, contraction: bool = True) -> Tensor:
    """Map world positions [M, 3] to grid coordinates [M, 3] in [0, 1].

    p = (x - mid) / half. With contraction (mip-NeRF 360, Barron et al. 2022, eq. 10): p becomes (2 - 1/|p|) p/|p| where
    |p| > 1, and (p + 2) / 4 is the grid coordinate. Without: (p + 1) / 2, clamped to [0, 1].
    """
    p = (x - mid) / half
    if not contraction:
        return ((p + 1) / 2).clamp(0, 1)
    squared = (p * p).sum(-1, keepdim=True)
    outside = squared > 1
    length = torch.where(outside, squared, 1.0).sqrt()
    return ((torch.where(outside, (2 - 1 / length) / length * p, p) + 2) / 4).clamp(0, 1)


def hash_index(corner: Tensor, table_size: int) -> Tensor:
    """Hash grid corners [M, 3] int64 to table rows [M]: XOR of coordinate times prime (uint32), mod table_size (Mueller
    et al. 2022, eq. 4)."""
    product = (corner * torch.tensor(PRIMES)) & 0xFFFFFFFF
    return (product[:, 0] ^ product[:, 1] ^ product[:, 2]) & (table_size - 1)


def encode(c: Tensor, table: Tensor, min_resolution: int = 256) -> Tensor:
    """Interpolate the features of a table [L, T, F], T a power of two, trilinearly at grid coordinates c [M, 3] in
    [0, 1]: [M, L F], level-major. Level l has resolution R_l = min_resolution 2^l; the position is c R_l, its cell the
    floor of that. All levels are hashed."""
    features = []
    for level in range(table.shape[0]):
        position = c * (min_resolution * 2**level)
        cell = position.detach().floor().long()
        fraction = position - cell  # [M, 3]
        feature = torch.zeros(c.shape[0], table.shape[2], dtype=table.dtype)
        for corner in itertools.product((0, 1), repeat=3):
            offset = torch.tensor(corner)
            weight = torch.where(offset == 1, fraction, 1 - fraction).prod(-1, keepdim=True)  # [M, 1]
            feature = feature + weight * table[level, hash_index(cell + offset, table.shape[1])]
        features.append(feature)
    return torch.cat(features, dim=-1)


def mlp(features: Tensor, w1: Tensor, w2: Tensor, w3: Tensor) -> Tensor:
    """Decode features [M, L F] to [M, 3]."""
    return torch.relu(torch.relu(features @ w1) @ w2) @ w3


def field(
    x: Tensor,
    table: Tensor,
    w1: Tensor,
    w2: Tensor,
    w3: Tensor,
    mid: Tensor,
    half: Tensor | float,
    min_resolution: int = 256,
    contraction: bool = True,
) -> Tensor:
    """Evaluate the residual colour rho(x) [M, 3] at world positions [M, 3]."""
    return mlp(encode(contract(x, mid, half, contraction), table, min_resolution), w1, w2, w3)
