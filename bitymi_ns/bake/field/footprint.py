"""What a pixel of the closest training view covers of a tile, and the mean of values over it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import torch
from torch import Tensor

from bitymi_ns.scene.camera import Camera
from bitymi_ns.scene.tile_sizes import max_projected_extent
from bitymi_ns.train.init import tangents


def closest_pixels(surfels: Mapping[str, Tensor], cameras: Sequence[Camera], extent: float, near: float) -> Tensor:
    """Pixels that a scale unit of every surfel takes along u and v in the view that shows it largest: [N, 2]; 0 where
    no view looks at it.

    Args:
        surfels: per-surfel parameters, N rows.
        cameras: training views.
        extent: half side in scale units of the square that has to be in the picture.
        near: nearest drawn depth.
    """
    at = (surfels["means"], tangents(surfels["quats"]), surfels["log_scales"].exp())
    return max_projected_extent(*at, cameras, extent, near)[0] / (2.0 * extent)


def cells_per_pixel(pixels: Tensor | None, extent: Tensor, size: tuple[int, int]) -> Tensor:
    """How many cells of a grid over a tile a pixel covers along u and v: [n, 2], from 1 to the side of the grid.

    Args:
        pixels: [n, 2] of `closest_pixels`; None = not known: a pixel covers one cell.
        extent: [n] half sides of the tiles, scale units.
        size: (u, v) cells.
    """
    sides = torch.tensor(size, dtype=torch.float32, device=extent.device).expand(len(extent), 2)
    if pixels is None:
        return torch.ones_like(sides)
    covered = sides / (2.0 * extent[:, None] * pixels).clamp(min=1e-9)
    return torch.minimum(covered.clamp(min=1.0), sides)


def averaged(values: Tensor, cells: Tensor) -> Tensor:
    """Means of values over rectangles about every cell: [n, c, v, u] of the same.

    A rectangle that would reach beyond the grid is moved into it. One of a single cell leaves its value.

    Args:
        values: [n, c, v, u].
        cells: [n, 2] sides of the rectangles along u and v, cells, from 1 to the side of the grid.
    """
    along_u, along_v = (_windows(values.shape[axis], cells[:, i]) for axis, i in ((3, 0), (2, 1)))
    across = torch.einsum("nij,ncvj->ncvi", along_u, values)
    return torch.einsum("nij,ncju->nciu", along_v, across)


def _windows(count: int, width: Tensor) -> Tensor:
    """[n, count, count] the share of every cell in the window of each, of widths [n]."""
    edge, half = torch.arange(count, device=width.device, dtype=torch.float32), width[:, None] / 2
    center = torch.minimum(torch.maximum(edge + 0.5, half), count - half)  # [n, count]
    low, high = (center - half)[:, :, None], (center + half)[:, :, None]
    return (torch.minimum(high, edge + 1) - torch.maximum(low, edge)).clamp(min=0) / width[:, None, None]
