"""Further first points, where the sparse points of a capture leave parts of its photographs empty.

Structure from motion finds few points on what is smooth or seen by few photographs: walls, the sky, a room behind the
subject. Densification can only halve the few large surfels there, too seldom in a short run, so such parts stay blurred
(docs/benchmarks/training.md, Background points).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from bitymi_ns.scene.camera import Camera
from bitymi_ns.train.views import View, as_float, downscale_image, downscale_mask, spread

CELLS = 24
"""Cells along the longer side of a photograph."""
MOST_VIEWS = 100
"""Photographs, spread over all, that are searched for empty cells."""
NEAREST, FARTHEST = 1.2, 5.0
"""Depths of the new points, in multiples of the median depth of the points that the photograph sees."""
FEW = 10
"""Points in a photograph below which its median depth is that of the others."""
RADIUS = 0.5
"""Largest first scale, in cells."""
OPAQUE = 0.5
"""Share of a cell that must show something."""
SUPPORT = 8
"""Fewest photographs that have a point in an empty cell: 17 photographs overfit points of fewer."""
IN_FRONT = 0.2
"""Most photographs that have it in front of the points of a cell, as a share of those."""


class BackgroundPoints(NamedTuple):
    """Points in empty cells, in random order.

    Attributes:
        xyz: [B, 3] world positions.
        rgb: [B, 3] mean colours of their cells, in [0, 1].
        scales: [B] largest first scales of their surfels, world units.
    """

    xyz: Tensor
    rgb: Tensor
    scales: Tensor


@torch.no_grad()
def background_points(points: Tensor, views: Sequence[View], seed: int) -> BackgroundPoints:
    """Place points behind the cells of the photographs that no sparse point projects to.

    A cell's point lies on the ray of a random pixel of it, at a depth that is log-uniform between `NEAREST` and
    `FARTHEST` times the median depth of the points that the photograph sees: between a wall and the sky. Masked and
    transparent cells get none. A point stays if at least `SUPPORT` photographs have it in an empty cell, so that
    training can find its depth, and few in front of the points of a cell.

    Args:
        points: [M, 3] world positions; those that are not finite do not count.
        views: training photographs at full size.
        seed: of the random pixels, depths and order.

    Returns:
        float32 on the CPU; no point where no photograph sees a point.
    """
    generator = torch.Generator().manual_seed(seed)
    points = points.detach().reshape(-1, 3).float().cpu()
    points = points[points.isfinite().all(-1)]
    chosen = [views[i] for i in spread(len(views), MOST_VIEWS)]
    cameras = [view.camera.to("cpu") for view in chosen]
    cells = [_Cells.of(camera, points) for camera in cameras]
    medians = [each.median for each in cells if each.median is not None]
    if not medians:
        return BackgroundPoints(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0))
    usual = float(torch.tensor(medians).median())
    found = [_behind(*each, usual, generator) for each in zip(chosen, cameras, cells, strict=True)]
    joined = BackgroundPoints(*map(torch.cat, zip(*found, strict=True)))
    empty, before = torch.zeros(2, len(joined.xyz))
    for camera, grid in zip(cameras, cells, strict=True):
        z, row, column, inside = _cells_of(camera, joined.xyz)
        nearest = grid.nearest[row, column]
        empty[inside] += nearest.isinf()
        before[inside] += nearest.isfinite() & (z < nearest)
    kept = ((empty >= SUPPORT) & (before <= IN_FRONT * empty)).nonzero().flatten()
    order = kept[torch.randperm(len(kept), generator=generator)]
    return BackgroundPoints(*(values[order] for values in joined))


class _Cells(NamedTuple):
    """Cells of a view.

    Attributes:
        nearest: [rows, columns] camera z of the nearest sparse point; infinite in empty cells.
        median: camera z of the points in the view; None where they are few.
    """

    nearest: Tensor
    median: float | None

    @classmethod
    def of(cls, camera: Camera, points: Tensor) -> _Cells:
        z, row, column, _ = _cells_of(camera, points)
        rows, columns = grid_size(camera)
        nearest = torch.full((rows * columns,), math.inf)
        nearest.scatter_reduce_(0, row * columns + column, z, "amin")
        return cls(nearest.view(rows, columns), float(z.median()) if len(z) >= FEW else None)


def grid_size(camera: Camera) -> tuple[int, int]:
    """Rows and columns of the cells of a view."""
    side = max(camera.width, camera.height) / CELLS
    return math.ceil(camera.height / side), math.ceil(camera.width / side)


def _cells_of(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Camera z, row and column, each [V], of those of the points [M, 3] that lie within the picture; which: [M]."""
    x, y, z = (points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]).unbind(-1)
    x, y = camera.K[0, 0] * x / z + camera.K[0, 2], camera.K[1, 1] * y / z + camera.K[1, 2]
    inside = (z > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    rows, columns = grid_size(camera)
    row, column = (y[inside] * (rows / camera.height)).long(), (x[inside] * (columns / camera.width)).long()
    return z[inside], row.clamp(max=rows - 1), column.clamp(max=columns - 1), inside


def _behind(view: View, camera: Camera, cells: _Cells, usual: float, generator: torch.Generator) -> BackgroundPoints:
    """A point behind each empty cell of a view.

    Args:
        camera: of the view, on the CPU.
        usual: median depth in the other views.
    """
    (rows, columns), K = grid_size(camera), camera.K
    small = downscale_image(as_float(view.image.cpu()), columns, rows)  # [rows, columns, C]
    empty = cells.nearest.isinf()
    if small.shape[-1] == 4:
        empty &= small[..., 3] > OPAQUE
    if view.mask is not None:
        empty &= downscale_mask(view.mask.cpu(), columns, rows)[..., 0]
    row, column = empty.nonzero().unbind(-1)
    random = torch.rand(len(row), 3, generator=generator)
    depth = NEAREST * (usual if cells.median is None else cells.median)
    z = depth * torch.exp(random[:, 2] * math.log(FARTHEST / NEAREST))
    across = ((column + random[:, 0]) * (camera.width / columns) - K[0, 2]) / K[0, 0]
    down = ((row + random[:, 1]) * (camera.height / rows) - K[1, 2]) / K[1, 1]
    local = torch.stack([across * z, down * z, z], -1)
    xyz = (local - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
    side = max(camera.width, camera.height) / CELLS
    return BackgroundPoints(xyz, small[row, column, :3], RADIUS * side * z / K[0, 0])
