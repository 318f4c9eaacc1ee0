"""The algebra of tiles as matrices along their two axes: what is read between texels, and the texels that fit best."""

from __future__ import annotations

from functools import lru_cache

import torch
from torch import Tensor


@lru_cache(maxsize=64)
def interpolation(probes: int, texels: int) -> Tensor:
    """Values at evenly spaced probes (cell centres) from a tile's texels along one axis: [probes, texels] float32.

    Linear between texel centres and constant beyond the outer ones, as the renderers fetch them.
    """
    x = ((torch.arange(probes, dtype=torch.float64) + 0.5) * texels / probes - 0.5).clamp(0, texels - 1)
    low = x.floor().long().clamp(max=max(texels - 2, 0))
    matrix = torch.zeros(probes, texels, dtype=torch.float64)
    rows = torch.arange(probes)
    matrix[rows, low] = 1 - (x - low)
    matrix[rows, (low + 1).clamp(max=texels - 1)] += x - low
    return matrix.float()


@lru_cache(maxsize=64)
def fit(probes: int, texels: int) -> Tensor:
    """[texels, probes] float32: the texels whose interpolation is nearest to values at the probes, least squares."""
    return torch.linalg.pinv(interpolation(probes, texels).double()).float()


def along_axes(x: Tensor, along_u: Tensor, along_v: Tensor) -> Tensor:
    """along_v x along_u^T of every channel: [n, 3, V, U] with [u, U], [v, V] -> [n, 3, v, u]."""
    y = (x @ along_u.T).transpose(2, 3)  # one product of matrices each
    return (y.contiguous() @ along_v.T).transpose(2, 3).contiguous()


def fitted(values: Tensor, size: tuple[int, int]) -> Tensor:
    """Tiles [n, 3, v, u] on another grid (u, v), by least squares."""
    u, v = values.shape[3], values.shape[2]
    return along_axes(values, fit(u, size[0]).to(values), fit(v, size[1]).to(values))


def read_at(texels: Tensor, size: tuple[int, int]) -> Tensor:
    """What tiles [n, 3, v, u] show on a finer grid (u, v)."""
    u, v = texels.shape[3], texels.shape[2]
    return along_axes(texels, interpolation(size[0], u).to(texels), interpolation(size[1], v).to(texels))
