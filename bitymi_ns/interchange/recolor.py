"""Colours of a mesh of quads, fitted to renders of the scene."""

from collections.abc import Callable, Sequence
from dataclasses import replace

import torch
from torch import Tensor

from bitymi_ns.codec.pages import size_classes, texel_index
from bitymi_ns.progress import Progress, no_progress
from bitymi_ns.scene.camera import Camera
from .quad_hits import nearest_hits
from .quads import Quads

PRIOR = 1.0  # weight of the previous colour, in pixels


@torch.no_grad()
def recolored(
    quads: Quads,
    picture: Callable[[Camera], Tensor],
    cameras: Sequence[Camera],
    near: float,
    progress: Progress = no_progress,
) -> Quads:
    """Fit the texels of quads to renders of the scene, at the pixels where they are nearest.

    Each quad's colours are first shifted by their mean difference from the renders, over its pixels; then each texel
    becomes the mean of its pixels. Both means include the previous value with the weight of PRIOR pixels. `picture`:
    renders a view, [H, W, 3]."""
    pages, height, width, _ = quads.pages.shape
    shift, shown = torch.zeros(len(quads), 3), torch.zeros(len(quads), 1)
    texels = torch.zeros(pages * height * width, 3)
    count = torch.zeros(pages * height * width, 1)
    flat = quads.pages.reshape(-1, 4).clone()
    for done, camera in enumerate(cameras, start=1):
        wanted = picture(camera).clamp(0.0, 1.0).reshape(-1, 3)
        hits = nearest_hits(quads, camera, near)
        x, y = (hits.uv * torch.tensor([width, height])).long().unbind(1)
        at = (quads.page[hits.quad] * height + y) * width + x
        one = torch.ones(len(at), 1)
        shift.index_add_(0, hits.quad, wanted[hits.pixel] - hits.color)
        shown.index_add_(0, hits.quad, one)
        texels.index_add_(0, at, wanted[hits.pixel])
        count.index_add_(0, at, one)
        progress("colouring the mesh", done, len(cameras))
    corners = quads.uv.double() * torch.tensor([width, height])  # centres of texels
    size = (corners[:, 2] - corners[:, 0]).round().long() + 1
    tiles = torch.cat([corners[:, 0].floor().long(), quads.page[:, None], size], dim=1)
    owner = torch.full((pages * height * width,), -1)  # the quad of each texel; -1: none
    for r_u, r_v, rows in size_classes(size):
        owner[texel_index(tiles[rows], (r_u, r_v), width, height)] = rows[:, None, None].expand(-1, r_v, r_u)
    owned = torch.nonzero(owner >= 0).squeeze(1)
    before = flat[owned, :3].float() / 255.0 + (shift / (shown + PRIOR))[owner[owned]]
    after = (PRIOR * before + texels[owned]) / (PRIOR + count[owned])
    flat[owned, :3] = (after.clamp(0.0, 1.0) * 255.0).round().to(torch.uint8)
    return replace(quads, pages=flat.view_as(quads.pages))
