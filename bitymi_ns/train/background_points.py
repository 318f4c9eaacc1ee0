"""Additional initial points where photographs show no sparse points: in a short run, densification splits the few large
surfels there too rarely (docs/benchmarks/training.md, Background points)."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import torch
from torch import Tensor

from bitymi_ns.ranges import spread
from bitymi_ns.scene.camera import Camera
from .views import View, as_float, downscale_image, downscale_mask

CELLS = 24  # maximum number of cells along the longer side of a photograph
POINTS_PER_CELL = 4  # minimum average: with fewer points, cells may be empty by chance
MOST_VIEWS = 100  # maximum number of photographs searched for empty cells, evenly spaced
NEAREST, FARTHEST = 1.2, 5.0
"""Depth range of the new points, relative to the median depth of the points visible in the photograph."""
FEW = 10  # photographs with fewer points use the median depth of the others
RADIUS = 0.5  # largest initial scale, in cells
OPAQUE = 0.5  # minimum mean alpha of a cell
SUPPORT = 8  # minimum number of photographs with the point in an empty cell: with fewer, training overfits
IN_FRONT = 0.2  # maximum number of photographs with the point in front of a cell's points, relative to those


class BackgroundPoints(NamedTuple):
    """Points in empty cells, in random order."""

    xyz: Tensor  # [B, 3] world positions
    rgb: Tensor  # [B, 3] mean colours of their cells, in [0, 1]
    scales: Tensor  # [B] upper bounds of their surfels' initial scales, world units


@torch.no_grad()
def background_points(points: Tensor, views: Sequence[View], seed: int) -> BackgroundPoints:
    """Sample points behind the cells of the photographs that no sparse point projects to.

    A point lies on the ray of a random pixel of its cell, at a log-uniform depth. Masked and transparent cells get
    none. It is kept if enough photographs have it in an empty cell (`SUPPORT`), and few in front of points
    (`IN_FRONT`).

    Args:
        points: [M, 3] world positions; those that are not finite are ignored.
        views: training photographs at full size.
        seed: seed of the random pixels, depths and order.

    Returns:
        float32 on the CPU; empty if no photograph shows a point.
    """
    generator = torch.Generator().manual_seed(seed)
    points = points.detach().reshape(-1, 3).float().cpu()
    points = points[points.isfinite().all(-1)]
    chosen = [views[i] for i in spread(len(views), MOST_VIEWS)]
    cameras = [view.camera.to("cpu") for view in chosen]
    seen = []  # pixel coordinates x, y and camera z, each [V], of the points in each picture
    for camera in cameras:
        *projected, inside = camera.project(points)
        seen.append([values[inside] for values in projected])
    medians = torch.stack([z.median() if len(z) >= FEW else torch.tensor(math.nan) for _, _, z in seen])
    counts = torch.tensor([float(len(z)) for _, _, z in seen])[medians.isfinite()]
    if len(counts) == 0:
        return BackgroundPoints(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0))
    medians = medians.nan_to_num(float(medians.nanmedian()))
    typical_count = float(counts.median())
    grids = [_Grid.of(camera, *shown, count=typical_count) for camera, shown in zip(cameras, seen, strict=True)]
    candidates = [
        _points_behind(view, camera, grid, float(median), generator)
        for view, camera, grid, median in zip(chosen, cameras, grids, medians, strict=True)
    ]
    joined = BackgroundPoints(*map(torch.cat, zip(*candidates, strict=True)))
    empty, before = torch.zeros(2, len(joined.xyz))
    for camera, grid in zip(cameras, grids, strict=True):
        x, y, z, inside = camera.project(joined.xyz)
        nearest = grid.at(x[inside], y[inside])
        empty[inside] += nearest.isinf()
        before[inside] += nearest.isfinite() & (z[inside] < nearest)
    kept = ((empty >= SUPPORT) & (before <= IN_FRONT * empty)).nonzero().flatten()
    order = kept[torch.randperm(len(kept), generator=generator)]
    return BackgroundPoints(*(values[order] for values in joined))


class _Grid(NamedTuple):
    nearest: Tensor  # [rows, columns] camera z of the nearest sparse point; infinite in empty cells
    # size of a cell, pixels
    width: float
    height: float

    @classmethod
    def of(cls, camera: Camera, x: Tensor, y: Tensor, z: Tensor, count: float) -> _Grid:
        """Bin the points of a view, [V] pixel coordinates and camera z, into nearly square cells. `count`: number of
        points that decides their size."""
        longer = max(camera.width, camera.height)
        shorter = min(camera.width, camera.height)
        side = longer / min(CELLS, max(1.0, math.sqrt(count / POINTS_PER_CELL * longer / shorter)))
        rows, columns = math.ceil(camera.height / side), math.ceil(camera.width / side)
        grid = cls(torch.full((rows, columns), math.inf), camera.width / columns, camera.height / rows)
        grid.nearest.view(-1).scatter_reduce_(0, grid._index(x, y), z, "amin")
        return grid

    def _index(self, x: Tensor, y: Tensor) -> Tensor:
        rows, columns = self.nearest.shape
        row = (y / self.height).long().clamp(max=rows - 1)
        column = (x / self.width).long().clamp(max=columns - 1)
        return row * columns + column

    def at(self, x: Tensor, y: Tensor) -> Tensor:
        """Return `nearest` at pixels [V]."""
        return self.nearest.view(-1)[self._index(x, y)]


def _points_behind(
    view: View, camera: Camera, grid: _Grid, median: float, generator: torch.Generator
) -> BackgroundPoints:
    """Sample a point behind each empty cell of a view whose points have the median depth `median`."""
    rows, columns = grid.nearest.shape
    small = downscale_image(as_float(view.image.cpu()), columns, rows)  # [rows, columns, C]
    empty = grid.nearest.isinf()
    if small.shape[-1] == 4:
        empty &= small[..., 3] > OPAQUE
    if view.mask is not None:
        empty &= downscale_mask(view.mask.cpu(), columns, rows)[..., 0]
    row, column = empty.nonzero().unbind(-1)
    random = torch.rand(len(row), 3, generator=generator)
    z = median * NEAREST * torch.exp(random[:, 2] * math.log(FARTHEST / NEAREST))
    xyz = camera.unproject((column + random[:, 0]) * grid.width, (row + random[:, 1]) * grid.height, z)
    return BackgroundPoints(xyz, small[row, column, :3], RADIUS * grid.width * z / camera.K[0, 0])
