"""Nearest quads of a mesh at the pixels of a view, by a depth buffer with alpha mask, on the CPU."""

import math
from collections.abc import Iterator
from dataclasses import dataclass

import torch
from torch import Tensor

from bitymi_ns.scene.camera import Camera
from .quads import MASK, Quads, bilinear

_AT_ONCE = 1 << 19  # pairs of quads and pixels per batch


@dataclass(frozen=True)
class QuadHits:
    """Nearest quads at pixel centres; empty pixels are omitted."""

    pixel: Tensor  # [F] y * width + x
    quad: Tensor  # [F] quad indices
    uv: Tensor  # [F, 2] float64 texture coordinates
    color: Tensor  # [F, 3] float32


@torch.no_grad()
def nearest_hits(quads: Quads, camera: Camera, near: float) -> QuadHits:
    """Find the nearest quad at each pixel. `near`: near plane, camera z.

    A ray r through a pixel, with r_z = 1, meets the plane of a quad of corner A and sides E, F (camera frame) where z r
    = A + s E + t F: s = r . (F x A) / r . n, t = r . (A x E) / r . n, z = A . n / r . n with n = E x F."""
    K, viewmat = camera.K.double(), camera.viewmat.double()
    corners = quads.corners.double() @ viewmat[:3, :3].T + viewmat[:3, 3]  # [Q, 4, 3]
    low, size, rows = _boxes(corners, K, near, camera.width, camera.height)
    corner = corners[rows, 0]
    sides = corners[rows][:, [1, 3]] - corner[:, None]
    normal = torch.linalg.cross(sides[:, 0], sides[:, 1])
    across = [torch.linalg.cross(sides[:, 1], corner), torch.linalg.cross(corner, sides[:, 0]), normal]
    planes = torch.stack(across, dim=1) @ torch.linalg.inv(K)  # of (x, y, 1) in pixels
    level = (corner * normal).sum(1)
    count = camera.width * camera.height
    depth = torch.full((count,), math.inf, dtype=torch.float64)
    quad = torch.full((count,), -1)
    uv = depth.new_zeros(count, 2)
    color = torch.zeros(count, 3)
    for part in _parts(size.prod(1)):
        own = part.repeat_interleave(size[part].prod(1))
        first = size[part].prod(1).cumsum(0) - size[part].prod(1)
        within = torch.arange(len(own)) - first[own - part[0]]
        x, y = low[own, 0] + within % size[own, 0], low[own, 1] + within // size[own, 0]
        s, t, w = (
            (planes[own] * torch.stack([x + 0.5, y + 0.5, torch.ones(len(x))], 1)[:, None].double()).sum(2).unbind(1)
        )
        w = torch.where(w.abs() > 1e-30, w, torch.nan)
        s, t, z, pixel = s / w, t / w, level[own] / w, y * camera.width + x
        met = torch.nonzero((s >= 0) & (s <= 1) & (t >= 0) & (t <= 1) & (z > near) & (z < depth[pixel])).squeeze(1)
        at = quads.uv[rows[own[met]]].double()
        at = at[:, 0] + s[met, None] * (at[:, 1] - at[:, 0]) + t[met, None] * (at[:, 3] - at[:, 0])
        texel = _fetch(quads.pages, quads.page[rows[own[met]]], at)
        there = texel[:, 3] >= MASK
        met, at, texel = met[there], at[there], texel[there]
        depth.scatter_reduce_(0, pixel[met], z[met], "amin")
        first = z[met] <= depth[pixel[met]]
        met = met[first]
        quad[pixel[met]] = rows[own[met]]
        uv[pixel[met]] = at[first]
        color[pixel[met]] = texel[first, :3]
    pixel = torch.nonzero(quad >= 0).squeeze(1)
    return QuadHits(pixel, quad[pixel], uv[pixel], color[pixel])


def _boxes(corners: Tensor, K: Tensor, near: float, width: int, height: int) -> tuple[Tensor, Tensor, Tensor]:
    """Bound quads in the image, clipped at the near plane: first pixels [M, 2], sizes [M, 2], quad indices [M]."""
    rows = torch.nonzero((corners[..., 2] > near).any(1)).squeeze(1)
    start, end = corners[rows], corners[rows].roll(-1, 1)
    along = (near - start[..., 2:]) / (end[..., 2:] - start[..., 2:])  # position along a side at the near plane
    meets = (along > 0) & (along < 1)
    points = torch.cat([start, start + torch.where(meets, along, 0.0) * (end - start)], dim=1)
    there = torch.cat([start[..., 2:] > near, meets], dim=1)
    at = (points @ K.T)[..., :2] / points[..., 2:].clamp(min=near)
    most = torch.tensor([width, height])
    first = (at.where(there, math.inf).amin(1) - 0.5).ceil().clamp(min=0).minimum(most).long()
    past = (at.where(there, -math.inf).amax(1) + 0.5).floor().clamp(min=0).minimum(most).long()
    inside = (past > first).all(1)
    return first[inside], (past - first)[inside], rows[inside]


def _parts(counts: Tensor) -> Iterator[Tensor]:
    """Split rows into consecutive batches of about `_AT_ONCE` pairs."""
    run = (counts.cumsum(0) - counts) // _AT_ONCE
    start = 0
    for length in torch.unique_consecutive(run, return_counts=True)[1].tolist():
        yield torch.arange(start, start + length)
        start += length


def _fetch(pages: Tensor, page: Tensor, uv: Tensor) -> Tensor:
    """Fetch texels [F, 4] float32 in [0, 1], bilinearly, from pages [P, height, width, 4] uint8 at uv [F, 2]."""
    size = torch.tensor([pages.shape[2], pages.shape[1]])
    at = uv * size - 0.5
    low = at.floor()
    weights = (at - low).float()
    low, high = (torch.minimum(c.clamp(min=0), size - 1) for c in (low.long(), low.long() + 1))
    return bilinear(lambda x, y: pages[page, y, x].float() / 255.0, low.unbind(1), high.unbind(1), weights.split(1, 1))
