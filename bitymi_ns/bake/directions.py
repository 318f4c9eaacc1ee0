"""Directions at which view colours are evaluated: of the training views that show a surfel, and others nearby."""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor
from torch.nn import functional as F

from bitymi_ns.ops.view_kinds import fibonacci_sphere

BETWEEN = 32  # directions between and around those of the views
SPHERE = 64  # directions over the sphere for a surfel that no view sees
_REACH = 1.25  # size relative to the triangle of three views
_CHUNK = 1 << 19  # directions at once


@dataclass(frozen=True)
class Directions:
    """Directions of some surfels."""

    rows: Tensor  # [n] int64 rows of the surfels
    unit: Tensor  # [n, D, 3] float32 unit vectors from camera to surfel, world frame; those of the views first
    valid: Tensor  # [n, D] bool; False: padding
    views: int  # number of columns for views
    view: Tensor  # [n, views] int64, their views

    def subset(self, values: Tensor, most: int) -> Tensor:
        """Select columns of `values` [n, D, ...]: at most `most` views, evenly, and every other of the rest."""
        stride = -(-self.views // most) if self.views else 1
        return torch.cat([values[:, : self.views : stride], values[:, self.views :: 2]], dim=1)


def view_directions(means: Tensor, seen: Tensor, centers: Tensor) -> Iterator[Directions]:
    """Yield the directions of all surfels, in chunks that about equally many views see.

    A surfel has the directions of the views that see it and BETWEEN random points of triangles of three of these,
    enlarged by a quarter; one that no view sees has SPHERE directions. `means`: [N, 3], `centers`: [V, 3] float64 of
    the cameras, world. `seen`: [V, N] bool."""
    count = seen.sum(0)  # [N]
    order = torch.argsort(count, stable=True)
    unseen = int((count == 0).sum())
    for rows in order[:unseen].split(_CHUNK // SPHERE):
        unit = fibonacci_sphere(SPHERE).to(means).expand(len(rows), -1, -1)
        yield Directions(rows, unit, torch.ones_like(unit[..., 0], dtype=torch.bool), 0, rows.new_zeros(len(rows), 0))
    g = torch.Generator().manual_seed(0)
    lot = torch.rand(BETWEEN, 3, generator=g).to(means)
    corner_weight = -torch.rand(BETWEEN, 3, generator=g).clamp(min=1e-6).log()  # normalised: uniform over the triangle
    corner_weight = (1 / 3 + _REACH * (corner_weight / corner_weight.sum(1, keepdim=True) - 1 / 3)).to(means)
    rest = order[unseen:]
    while len(rest):
        # the last of a chunk is seen by the most views
        size = max(1, _CHUNK // (int(count[rest[min(len(rest), 4096) - 1]]) + BETWEEN))
        rows, rest = rest[: min(size, 4096)], rest[min(size, 4096) :]
        most = int(count[rows[-1]])
        by_view = seen[:, rows].T  # [n, V]
        index = torch.argsort(by_view.to(torch.uint8), dim=1, descending=True, stable=True)[:, :most]
        unit = F.normalize(means[rows].double()[:, None] - centers[index].to(means.device), dim=2).to(means)
        drawn = (lot * count[rows, None, None]).long().flatten(1)[..., None].expand(-1, -1, 3)
        corners = unit.gather(1, drawn).unflatten(1, (BETWEEN, 3))
        between = F.normalize((corners * corner_weight[..., None]).sum(2), dim=2)
        valid = F.pad(by_view.gather(1, index), (0, BETWEEN), value=True)
        yield Directions(rows, torch.cat([unit, between], dim=1), valid, most, index)
