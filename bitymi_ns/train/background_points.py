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
    """Place a point behind every cell of a photograph that no sparse point projects to.

    A cell's point lies on the ray of a random pixel of it, at a depth that is log-uniform between `NEAREST` and
    `FARTHEST` times the median depth of the points that the photograph sees: between a wall and the sky. Cells that are
    masked out or transparent get none.

    Args:
        points: [M, 3] world positions; those that are not finite do not count.
        views: training photographs at full size, on the CPU.
        seed: of the random pixels, depths and order.

    Returns:
        float32 on the CPU; no point where no photograph sees a point.
    """
    generator = torch.Generator().manual_seed(seed)
    points = points.detach().reshape(-1, 3).float().cpu()
    points = points[points.isfinite().all(-1)]
    chosen = spread(len(views), MOST_VIEWS)
    seen = [_projected(points, views[i]) for i in chosen]
    medians = {i: z.median() for i, (z, _, _) in zip(chosen, seen, strict=True) if len(z) >= FEW}
    if not medians:
        return BackgroundPoints(torch.zeros(0, 3), torch.zeros(0, 3), torch.zeros(0))
    usual = torch.stack(list(medians.values())).median()
    found = [
        _behind_empty_cells(views[i], *pixels, medians.get(i, usual), generator)
        for i, (_, *pixels) in zip(chosen, seen, strict=True)
    ]
    joined = BackgroundPoints(*map(torch.cat, zip(*found, strict=True)))
    order = torch.randperm(len(joined.xyz), generator=generator)
    return BackgroundPoints(*(values[order] for values in joined))


def _projected(points: Tensor, view: View) -> tuple[Tensor, Tensor, Tensor]:
    """Depths and pixel coordinates x, y of the points within the picture, each [V]."""
    camera = view.camera.to("cpu")
    x, y, z = (points @ camera.viewmat[:3, :3].T + camera.viewmat[:3, 3]).unbind(-1)
    x, y = camera.K[0, 0] * x / z + camera.K[0, 2], camera.K[1, 1] * y / z + camera.K[1, 2]
    inside = (z > 0) & (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    return z[inside], x[inside], y[inside]


def _behind_empty_cells(
    view: View, x: Tensor, y: Tensor, depth: Tensor, generator: torch.Generator
) -> BackgroundPoints:
    """The points of one view.

    Args:
        x, y: [V] pixel coordinates of the sparse points in it.
        depth: median depth, camera z.
    """
    camera, K = view.camera.to("cpu"), view.camera.K.cpu()
    side = max(camera.width, camera.height) / CELLS
    columns, rows = math.ceil(camera.width / side), math.ceil(camera.height / side)
    small = downscale_image(as_float(view.image.cpu()), columns, rows)  # [rows, columns, C]
    empty = torch.ones(rows, columns, dtype=torch.bool)
    empty[(y * (rows / camera.height)).long(), (x * (columns / camera.width)).long()] = False
    if small.shape[-1] == 4:
        empty &= small[..., 3] > OPAQUE
    if view.mask is not None:
        empty &= downscale_mask(view.mask.cpu(), columns, rows)[..., 0]
    row, column = empty.nonzero().unbind(-1)
    random = torch.rand(len(row), 3, generator=generator)
    z = depth * NEAREST * torch.exp(random[:, 2] * math.log(FARTHEST / NEAREST))
    across = ((column + random[:, 0]) * (camera.width / columns) - K[0, 2]) / K[0, 0]
    down = ((row + random[:, 1]) * (camera.height / rows) - K[1, 2]) / K[1, 1]
    local = torch.stack([across * z, down * z, z], -1)
    xyz = (local - camera.viewmat[:3, 3]) @ camera.viewmat[:3, :3]
    return BackgroundPoints(xyz, small[row, column, :3], RADIUS * side * z / K[0, 0])
